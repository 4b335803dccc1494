// What is said of a result beside its drawings: status, corrections, files, provenance.
import { $, el } from "./dom.js";

export function status(store) {
  const box = $("status"), { job, result } = store;
  box.hidden = !(job || result) || store.running;
  if (box.hidden) return;
  const word = result ? result.summary.status : job.state;
  box.className = `status ${word}`;
  if (!result) { box.replaceChildren(el("b", {}, word), store.words(job.error?.message ?? "")); return; }
  const { summary } = result, findings = summary.findings.length > 1 ? summary.findings : [];
  const facts = [["views apart", `${summary.separation_deg.toFixed(0)}\u00b0`], ["branches", summary.tree.branches.length],
    ["centreline", `${summary.tree.length_mm.toFixed(0)} mm`], ["time", `${summary.seconds.total.toFixed(1)} s`]];
  const list = (name, lines, kind) => lines.length ? el("details", { class: kind }, el("summary", {}, `${name} (${lines.length})`), el("ul", {}, ...lines.map(text => el("li", {}, store.words(text))))) : null;
  // In a row that is there already: the pictures must not move under a stroke.
  const older = store.stale ? el("span", { class: "older" }, "older than the corrections: Reconstruct") : null;
  box.replaceChildren(el("b", {}, word), summary.sentence,
    el("div", { class: "facts" }, older, ...facts.map(([name, value]) => el("span", {}, `${name} `, el("b", {}, String(value)))),
      list("Findings", findings, "said"), list("Notes", summary.notes, "notes"), list("What no picture can show", summary.silent_errors, "silent")));
}

/** One line a stated alternative, to be looked at and, where a correction picks it, picked. */
export function alternatives(store, pick) {
  const found = store.result?.alternatives ?? [];
  $("alternatives").hidden = !found.length;
  $("alternatives").querySelector("ul").replaceChildren(...found.map(one => el("li", {}, one.text,
    el("button", { type: "button", class: "small", "aria-label": `Show: ${one.text}`, onclick: () => store.show(one) }, "Show"),
    one.does ? el("button", { type: "button", class: "small", "aria-label": `${one.does}: ${one.text}`, onclick: () => pick(one) }, one.does) : null)));
}

/** One line a correction, each of which can be taken back by itself. */
export function corrections(store, say) {
  const now = store.now, lines = [];
  const add = (text, values) => lines.push(el("li", {}, text, el("button", { type: "button", class: "small", "aria-label": `Take back: ${text}`,
    onclick: () => store.change(values).then(() => values.deleted_mm !== undefined && store.run()).catch(error => say(error.message)) }, "\u00d7")));
  const without = (list, k) => list.filter((_, i) => i !== k);
  for (const [view, strokes] of Object.entries(now.edits ?? {})) strokes.forEach((stroke, k) => {
    const left = without(strokes, k), edits = { ...now.edits, [view]: left };
    if (!left.length) delete edits[view];
    add(`View ${view}: ${stroke.do === "erase" ? "erased" : "painted"}`, { edits });
  });
  for (const view of Object.keys(now.regions ?? {})) {
    const { [view]: _, ...regions } = now.regions;
    add(`View ${view}: region`, { regions });
  }
  (now.landmarks ?? []).forEach((_, k) => add(`Landmark L${k + 1}`, { landmarks: without(now.landmarks, k) }));
  (now.same_branch ?? []).forEach((_, k) => add(`Same branch B${k + 1}`, { same_branch: without(now.same_branch, k) }));
  (now.ostia ?? []).forEach((_, k) => add(`Ostium O${k + 1}`, { ostia: without(now.ostia, k) }));
  (now.deleted_mm ?? []).forEach((place, k) => add(`Deleted branch ${store.gone.get(JSON.stringify(place)) ?? `at (${place.map(x => x.toFixed(0)).join(", ")}) mm`}`, { deleted_mm: without(now.deleted_mm, k) }));
  if (now.geometry && store.told !== undefined && JSON.stringify(now.geometry) !== JSON.stringify(store.told)) add("Geometry", { geometry: store.told });
  if (now.pixel_spacing_mm) add(`Pixel at the detector ${now.pixel_spacing_mm} mm`, { pixel_spacing_mm: null });
  if (now.sod_mm) add(`Source to isocentre ${now.sod_mm} mm`, { sod_mm: null });
  $("corrections").hidden = !lines.length;
  $("corrections").querySelector("ul").replaceChildren(...lines);
}

const ABOUT = {
  "report.html": "report, one page for the record", "result.json": "all figures", "volume.nii.gz": "volume (NIfTI)",
  "surface.stl": "surface", "centerline.vtp": "centreline (VTK)",
  "centerline.csv": "centreline (table)", "diameters.csv": "diameters (table)", "gaussians.npz": "Gaussians", "gaussians.ply": "Gaussians (3DGS)",
};

/** A path as a shell takes it. */
const quoted = path => /^[\w./:\\-]+$/.test(path) ? path : `'${path.replaceAll("'", "'\\''")}'`;

export function files(store) {
  const room = $("files-of").querySelector("div");
  $("files-of").hidden = !store.result;
  if (!store.result) return;
  const { summary, files: sizes } = store.result, base = `/files/${store.info.key}`;
  const link = name => el("a", { href: `${base}/${name}`, ...(name === "report.html" ? { target: "_blank" } : { download: name }) },
    `${name}${ABOUT[name] ? ` \u2013 ${ABOUT[name]}` : ""}`);
  const model = one => one ? `${one.name} (${one.sha256.slice(0, 12)})` : "none";
  const rows = [["Order", store.info.order_file], ["Repeat", `gcar run --order ${quoted(store.info.order_file)}`],
    ["Centres", summary.predictor], ["Model", model(summary.model)], ["Vessel network", model(summary.segmenter)],
    ["Refinement", `${summary.refiner}, ${summary.counts.steps} steps`],
    ...summary.views.map(v => [`Picture ${v.id}`, `${v.picture.columns} x ${v.picture.rows}, ${v.picture.bit_depth} bit, ${v.kind}, SHA-256 ${v.picture.sha256.slice(0, 12)}`]),
    ...Object.entries(summary.versions).map(([name, version]) => [name, version ?? "not installed"])];
  room.replaceChildren(el("div", { class: "links" }, link("order.json"), ...Object.keys(sizes).map(link)),
    el("table", { class: "names" }, el("tbody", {}, ...rows.map(([name, value]) => el("tr", {}, el("th", { scope: "row" }, name), el("td", {}, value))))));
}
