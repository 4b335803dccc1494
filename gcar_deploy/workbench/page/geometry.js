// Where each view was taken from: a drawing of the C-arm, and its numbers to be edited.
import * as api from "./api.js";
import { $, direction, el } from "./dom.js";

/** What the counts of a picture can be. */
const KINDS = [["raw", "an X-ray picture as it was taken"], ["mask", "a mask: vessel or not"], ["path_length", "lengths of the path through vessel"]];
const FIELDS = [
  ["primary_angle_deg", "RAO \u2212 / LAO +", "\u00b0", -180, 180, "\u221230"],
  ["secondary_angle_deg", "Caudal \u2212 / cranial +", "\u00b0", -90, 90, "25"],
  ["detector_rotation_deg", "Detector turned", "\u00b0", -360, 360],
  ["sod_mm", "Source to isocentre", "mm", 300, 5000, "750"],
  ["sdd_mm", "Source to detector", "mm", 300, 8000, "1100"],
  ["pixel_spacing_mm", "Pixel at the detector", "mm", 0.02, 10, "0.2"],
];

/** Show one card a view; what is edited becomes part of the order. */
export function geometry(store, say) {
  const [cards, order] = [".cards", ".order"].map(name => $("geometry").querySelector(name));
  const told = store.info.geometry;
  order.replaceChildren();
  if (Object.keys(store.info.lacks).length) { cards.replaceChildren(lacking(store, say)); return; }
  if (!told && store.info.sizes) { cards.replaceChildren(asked(store, say)); return; }
  if (!told) { cards.replaceChildren(el("p", {}, store.words(store.info.problem) ?? "Not known.")); return; }
  // A header's geometry belongs to its picture.
  const mixed = store.info.order.geometry && told.views.length > 1;
  cards.replaceChildren(...told.views.map((view, k) => card(store, say, view, k)));
  if (mixed) order.replaceChildren(...told.views.slice(1).map((_, k) => exchange(store, say, k)), "for pictures that came in the wrong order");
}

/** A button for pictures that came in the wrong order: what was drawn in them stays with them. */
function exchange(store, say, k) {
  const onclick = () => {
    const told = structuredClone(store.info.geometry), [a, b] = told.views.slice(k, k + 2);
    // What a picture is called and what its counts mean are the picture's own.
    const of = (whole, { id, intensity }) => {
      const { id: _, intensity: __, ...placed } = whole;
      return { ...id !== undefined && { id }, ...placed, ...intensity !== undefined && { intensity } };
    };
    told.views.splice(k, 2, of(b, a), of(a, b));
    apply(store, say, { geometry: told });
  };
  return el("button", { type: "button", onclick }, `Exchange the geometry of views ${k + 1} and ${k + 2}`);
}

/** What is wrong with the geometry, and what the page asks for. */
export function problem(store) {
  const { info } = store, lacks = Object.entries(info.lacks);
  if (lacks.length) return `${lacks.map(([key, views]) => `The header of ${views.map(k => info.names[k - 1]).join(" and ")} does not say ${LACKS[key]}.`).join(" ")} Say it below.`;
  if (!info.sizes) return info.problem;
  // What follows is of the command's options.
  if (info.dicom.every(is => is)) return `${info.problem.split("; ")[0]}. Say below where each was taken from.`;
  return "These pictures came without their geometry. Say below where each was taken from, or drop them again together with their geom.json.";
}
const LACKS = { pixel_spacing_mm: "how large a pixel is at the detector", sod_mm: "how far the source is from the isocentre" };
const field = key => FIELDS.find(([own]) => own === key);

/** The picture as it is: what stands in it may tell where it was taken from. */
function bare(store, say, k) {
  const picture = el("img", { alt: `Picture of view ${k + 1}` }), link = el("a", { target: "_blank", title: "Full size" }, picture);
  api.imageUrl(`${store.path}/views/${k + 1}/bare.png`).then(url => { picture.src = link.href = url; }).catch(error => say(error.message));
  return link;
}
const blank = ([key, , , least, most, example], id) =>
  el("input", { type: "number", id, name: key, min: least, max: most, step: "any", required: true, placeholder: `e.g. ${example}` });
const asks = inputs => el("div", { class: "numbers" }, ...inputs.flatMap(([name, unit, input]) => [el("label", { for: input.id }, name), input, el("span", {}, unit)]));
/** Make values part of the order, and run it if nothing else is missing. */
async function apply(store, say, values) {
  try {
    await store.change(values);
    if (!store.info.problem) { say(""); await store.run(); }
  } catch (error) { say(error.message); }
}
const form = (store, say, values, ...rest) => el("form", { class: "cards asked", onsubmit: e => {
  e.preventDefault();
  apply(store, say, values());
} }, ...rest);
const titled = (store, k, size = "") => el("h3", {}, `View ${k + 1}: ${store.info.names[k]}${size}`);

/** A form for what headers of runs do not say: one value holds for all runs. */
function lacking(store, say) {
  const inputs = Object.keys(store.info.lacks).map(key => { const [, name, unit] = field(key); return [name, unit, blank(field(key), `lack-${key}`)]; });
  return form(store, say, () => Object.fromEntries(inputs.map(([, , input]) => [input.name, Number(input.value)])),
    ...store.info.names.map((_, k) => el("div", { class: "carm bare" }, titled(store, k), bare(store, say, k))),
    el("div", {}, asks(inputs), el("p", { class: "hint" }, "It holds for all runs that do not say it themselves."), el("button", { class: "main" }, "Use this")));
}

/** A form for pictures that came without their geometry: nothing is guessed, all is asked. */
function asked(store, say) {
  const views = store.info.sizes.map(([rows, columns], k) => {
    const inputs = FIELDS.filter(([key]) => key !== "detector_rotation_deg").map(one => [one[1], one[2], blank(one, `new-${one[0]}-${k}`)]);
    return { rows, columns, inputs, node: el("div", { class: "carm bare" }, titled(store, k, `, ${columns} x ${rows}`), bare(store, say, k), asks(inputs)) };
  });
  const scale = el("input", { type: "number", id: "new-scale", min: 1e-9, max: 1000, step: "any" });
  const per = el("span", { hidden: true }, el("label", { for: scale.id }, " mm per count "), scale);
  const kind = el("select", { id: "new-kind", onchange: () => {
    per.hidden = kind.value !== "path_length"; scale.required = !per.hidden;
  } }, ...KINDS.map(([value, text]) => el("option", { value }, text)));
  const whole = () => {
    const intensity = kind.value === "path_length" ? { kind: kind.value, mm_per_count: Number(scale.value) } : { kind: kind.value };
    const read = ({ rows, columns, inputs }, k) => {
      const told = Object.fromEntries(inputs.map(([, , input]) => [input.name, Number(input.value)]));
      return { id: String(k + 1), ...told, rows, columns, intensity, pixel_spacing_mm: [told.pixel_spacing_mm, told.pixel_spacing_mm] };
    };
    return { geometry: { schema: "gcar-geometry/1", frame: "LPS", views: views.map(read) } };
  };
  return form(store, say, whole, ...views.map(view => view.node),
    el("div", {}, el("p", {}, el("label", { for: kind.id }, "The pictures are "), kind, per), el("button", { class: "main" }, "Use this geometry")));
}

function card(store, say, view, k) {
  const numbers = FIELDS.flatMap(([key, name, unit, least, most]) => {
    const value = key === "pixel_spacing_mm" ? view[key][0] : view[key] ?? 0;
    const input = el("input", { type: "number", id: `${key}-${k}`, min: least, max: most, step: "any", value,
      onchange: e => edit(store, say, k, key, e.target) });
    return [el("label", { for: `${key}-${k}` }, name), input, el("span", {}, unit)];
  });
  return el("div", { class: "carm" }, el("h3", {}, `View ${view.id ?? k + 1}: ${direction(view.primary_angle_deg, view.secondary_angle_deg)} (${store.info.names[k]})`),
    drawing(view), el("div", { class: "numbers" }, ...numbers));
}

async function edit(store, say, k, key, input) {
  const value = Number(input.value);
  if (!input.checkValidity() || input.value === "") { geometry(store, say); say(`View ${k + 1}: ${key} must be ${input.min} .. ${input.max}`); return; }
  const told = structuredClone(store.info.geometry);
  told.views[k][key] = key === "pixel_spacing_mm" ? [value, value] : value;
  try { await store.change({ geometry: told }); if (!store.info.problem) say(""); } catch (error) {
    // What was refused must not stand in its field.
    geometry(store, say);
    say(error.message);
  }
}

const NS = "http://www.w3.org/2000/svg";
function svg(name, attributes, ...children) {
  const made = document.createElementNS(NS, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.append(...children);
  return made;
}
const at = (degrees, radius) => [radius * Math.sin(degrees * Math.PI / 180), -radius * Math.cos(degrees * Math.PI / 180)];

/** A beam through the patient: source below, detector above, as at zero degrees. */
function dial(degrees, y, words, body) {
  const [dx, dy] = at(degrees, 44), [sx, sy] = at(degrees + 180, 50);
  const turned = `rotate(${degrees})`;
  return svg("g", { transform: `translate(66 ${y})` },
    svg("circle", { r: 50, fill: "none", stroke: "var(--line)" }), body,
    svg("path", { d: `M ${sx} ${sy} L ${dx} ${dy}`, stroke: "var(--link)", "stroke-width": 2 }),
    svg("rect", { x: -18, y: -48, width: 36, height: 9, rx: 2, fill: "var(--ink)", transform: turned }),
    svg("circle", { cx: sx, cy: sy, r: 6, fill: "#e69f00", stroke: "var(--ink)" }),
    ...words.map(([text, x, ty]) => { const t = svg("text", { x, y: ty, "font-size": 10, "text-anchor": "middle", fill: "var(--soft)" }); t.textContent = text; return t; }));
}

function drawing(view) {
  // Seen from the feet: the patient's left is on the right of the drawing.
  const axial = dial(view.primary_angle_deg, 64, [["RAO", -52, -40], ["LAO", 52, -40]],
    svg("ellipse", { rx: 26, ry: 17, fill: "#f3d9c4", stroke: "#b08c70" }));
  // Seen from the patient's left: the head is on the right.
  const sagittal = dial(view.secondary_angle_deg, 200, [["CAU", -52, -40], ["CRA", 52, -40]],
    svg("g", {}, svg("rect", { x: -34, y: -12, width: 52, height: 24, rx: 10, fill: "#f3d9c4", stroke: "#b08c70" }),
      svg("circle", { cx: 27, r: 10, fill: "#f3d9c4", stroke: "#b08c70" })));
  const name = `C-arm at ${direction(view.primary_angle_deg, view.secondary_angle_deg)}, from the feet and from the left`;
  return svg("svg", { viewBox: "0 0 132 264", role: "img", "aria-label": name }, axial, sagittal);
}
