// The table of narrowings, and the diameter along a vessel from the ostium to its tip.
import { $, el, inside, nameOf, pen, ring, tone } from "./dom.js";

const fixed = (value, digits) => value === null || value === undefined ? "\u2013" : value.toFixed(digits);
const COLUMNS = [
  ["Vessel", ""], ["Stenosis", "% diameter"], ["", "% area"], ["Narrowing", "mm"], ["Reference", "mm (proximal, distal)"],
  ["Lesion", "mm"], ["From ostium", "mm"], ["Length", "mm"], ["Ghost", "%"], ["", ""],
];
export const area = percent => percent === null ? null : 100 * (1 - (1 - percent / 100) ** 2);

/** Branches that are narrowed by less, %, and have no lesion, are listed on demand; the first ones always. */
const SLIGHT = 20, FEW = 3;

/** Healthy diameter at the narrowing, and at both borders of the lesion where there is one. */
const reference = row => [fixed(row.reference_diameter_mm, 2),
  (row.proximal_reference_mm ?? null) === null ? "" : el("small", { class: "ends" }, `${fixed(row.proximal_reference_mm, 2)}, ${fixed(row.distal_reference_mm, 2)}`)];

/** Further lesions of a branch, and what it narrows to where that is no lesion. */
const besides = row => {
  const told = (row.lesions ?? []).slice(1).map(one => `${Math.round(one.stenosis_percent)} at ${one.minimal_at_mm.toFixed(0)} mm`);
  if (row.narrows_to_mm) told.push(`narrows to ${row.narrows_to_mm.toFixed(1)} mm`);
  return told.length ? el("small", { class: "besides", title: "further lesions, mm from the branch's inlet; narrowing without recovery is none" }, ` ${told.join(", ")}`) : "";
};

/** Class of a row: what is narrowed little, and where nothing can be said of it, is listed on demand. */
const kind = (row, rank) => {
  const percent = row.stenosis_percent;
  if (percent >= 50) return "severe";
  if (rank < FEW || row.lesion_length_mm) return "";
  return percent === null ? "unsaid" : percent < SLIGHT ? "slight" : "";
};

/** Fill the table, the most severe narrowing first; erase is called with a branch to delete. */
export function table(store, erase) {
  const branches = [...store.result.scene.branches].sort((a, b) => (b.stenosis ?? -1) - (a.stenosis ?? -1) || a.branch - b.branch);
  const rows = branches.map((branch, rank) => {
    const { row } = branch, percent = row.stenosis_percent;
    const cells = [percent === null ? "\u2013" : [`${Math.round(percent)}`, besides(row)], percent === null ? "\u2013" : `${Math.round(area(percent))}`,
      fixed(row.minimal_diameter_mm, 2), reference(row), fixed(row.lesion_length_mm || null, 1),
      row.minimal_at_mm === null || branch.from_ostium === null ? "\u2013" : (branch.from_ostium + row.minimal_at_mm).toFixed(0), fixed(row.length_mm, 0),
      row.ghost_probability === null ? "\u2013" : `${Math.round(100 * row.ghost_probability)}`];
    const jump = el("button", { type: "button", class: "plain" }, el("span", {}, el("span", { class: "swatch" }), nameOf(branch)),
      // Rounded down: what is not certain never reads 100 %.
      row.name ? el("small", { title: "probability of the name by anatomy" }, ` ${Math.floor(100 * row.name_confidence)} %`) : "");
    jump.querySelector(".swatch").style.background = branch.color;
    const drop = el("button", { type: "button", class: "small", "aria-label": `Delete branch ${branch.branch}`, title: "Delete this branch (Delete)", onclick: e => { e.stopPropagation(); erase(branch); } }, "Delete");
    return el("tr", { "data-branch": branch.branch, class: kind(row, rank), onclick: () => jumpTo(store, branch) },
      el("td", {}, jump), ...cells.map(content => el("td", {}, content)), el("td", {}, drop));
  });
  $("lesions").replaceChildren(
    el("thead", {}, el("tr", {}, ...COLUMNS.map(([name, unit], k) => el("th", { scope: "col" }, name || (k === 9 ? el("span", { class: "swatch", hidden: true }) : "\u00a0"), el("small", {}, unit))))),
    el("tbody", {}, ...rows));
  more();
  $("lesion-note").textContent = "Bold: narrower by half or more. Reference: healthy diameter at the narrowing, by a line through the wider parts. Ghost: share of the branch expected more than 2 mm from any vessel; dashed where it is probably one.";
}

/** Say what is not listed, and offer it. */
export function more() {
  const [slight, unsaid] = [".slight", ".unsaid"].map(one => $("lesions").querySelectorAll(one).length);
  const all = $("lesions").classList.contains("all");
  $("more").hidden = !slight && !unsaid;
  $("more").classList.toggle("back", all);
  const told = [slight ? `${slight} narrowed by less than ${SLIGHT} %` : "", unsaid ? `${unsaid} too short to say` : ""];
  $("more").textContent = all ? "Narrowings alone" : `and ${told.filter(text => text).join(", ")}`;
}

/** Choose a branch and mark its narrowing in every drawing. */
export function jumpTo(store, branch) {
  store.choose(branch.branch);
  if (branch.least) store.point({ branch: branch.branch, at: nearest(branch.arc, branch.least[0]) });
}
/** From where distances count: a part that does not hang on the ostium's has its own beginning. */
const from = branch => branch.from_ostium === null ? "along the vessel, which does not hang on the ostium" : "from the ostium";
const nearest = (list, value) => list.reduce((best, x, i) => Math.abs(x - value) < Math.abs(list[best] - value) ? i : best, 0);

export class Curve {
  constructor(store) {
    this.store = store; this.way = null;
    const canvas = this.canvas = $("curve");
    const point = e => { const place = this.nearestTo(inside(e, canvas)[0]); if (place) store.point(place); };
    canvas.addEventListener("pointermove", point);
    canvas.addEventListener("pointerdown", point);
    canvas.addEventListener("keydown", e => {
      const step = { ArrowLeft: -1, ArrowRight: 1, PageUp: -10, PageDown: 10 }[e.key];
      if (!step || !this.parts) return;
      e.preventDefault();
      const all = this.parts.flatMap(part => part.branch.arc.map((_, at) => ({ branch: part.branch.branch, at })));
      const now = store.cursor ? all.findIndex(p => p.branch === store.cursor.branch && p.at === store.cursor.at) : 0;
      store.point(all[Math.max(0, Math.min(all.length - 1, now + step))]);
    });
    $("way").addEventListener("change", () => { this.way = Number($("way").value); this.draw(); });
  }
  /** Take a new result: every way from an ostium to a tip. */
  take() {
    const { ways } = this.store.result;
    $("way").replaceChildren(...ways.map((way, k) => {
      const names = [...new Set(way.map(n => this.store.branch(n).name).filter(n => n))].join(" \u2013 ");
      return el("option", { value: k }, `to branch ${way.at(-1)}${names ? ` (${names})` : ""}`);
    }));
    this.follow();
  }
  /** Show a way that the chosen branch is part of. */
  follow() {
    const ways = this.store.result?.ways ?? [];
    if (!ways[this.way]?.includes(this.store.chosen)) this.way = Math.max(0, ways.findIndex(way => way.includes(this.store.chosen)));
    $("way").value = String(this.way);
    this.draw();
  }
  nearestTo(x) {
    const s = this.frame?.s(x);
    const part = this.parts?.findLast(one => one.start <= s + 1e-9) ?? this.parts?.[0];
    return part ? { branch: part.branch.branch, at: nearest(part.branch.arc, s - part.start) } : null;
  }
  draw() {
    const [ctx, width, height] = pen(this.canvas), way = this.store.result?.ways[this.way];
    if (!way) { this.parts = null; return; }
    let along = 0;
    const parts = this.parts = way.map(number => {
      const branch = this.store.branch(number), part = { branch, start: branch.from_ostium ?? along };
      along = part.start + branch.arc.at(-1);
      return part;
    });
    const last = parts.at(-1), length = last.start + last.branch.arc.at(-1);
    const widest = Math.max(...parts.flatMap(p => [...p.branch.radius, ...p.branch.reference.map(r => r ?? 0)]));
    const most = Math.max(1, Math.ceil(2 * widest)), left = 34, right = width - 8, top = 18, bottom = height - 32;
    const x = s => left + (right - left) * s / length, y = w => bottom - (bottom - top) * w / most;
    this.frame = { s: px => (px - left) / (right - left) * length };
    this.axes(ctx, { from: from(parts[0].branch), left, right, top, bottom, most, length, x, y });
    for (const { branch, start } of parts) {
      for (const lesion of branch.lesion ? [branch.lesion, ...branch.further] : []) {
        const [begin, end] = lesion.map(s => x(start + s));
        ctx.fillStyle = tone("lesion"); ctx.fillRect(begin, top, Math.max(3, end - begin), bottom - top);
      }
      ctx.strokeStyle = tone("soft"); ctx.lineWidth = 1.5; ctx.setLineDash([5, 4]); ctx.beginPath();
      let down = false;
      branch.arc.forEach((s, i) => { const r = branch.reference[i]; if (r !== null) { ctx[down ? "lineTo" : "moveTo"](x(start + s), y(2 * r)); down = true; } });
      ctx.stroke(); ctx.setLineDash([]);
      ctx.strokeStyle = tone("link"); ctx.lineWidth = branch.branch === this.store.chosen ? 3.2 : 1.8; ctx.beginPath();
      branch.arc.forEach((s, i) => ctx[i ? "lineTo" : "moveTo"](x(start + s), y(2 * branch.radius[i])));
      ctx.stroke();
      if (start > 0) { ctx.strokeStyle = tone("line"); ctx.lineWidth = 1; ctx.beginPath(); ctx.moveTo(x(start), top); ctx.lineTo(x(start), bottom); ctx.stroke(); }
      if (branch.least) ring(ctx, x(start + branch.least[0]), y(branch.least[1]), 4, "#d55e00", "#fff");
    }
    this.names(ctx, parts.map(part => [part.branch, x(part.start + part.branch.arc.at(-1) / 2)]), width);
    const { cursor } = this.store, part = cursor && parts.find(p => p.branch.branch === cursor.branch);
    if (part) {
      const s = part.start + part.branch.arc[cursor.at];
      ctx.strokeStyle = tone("pair"); ctx.lineWidth = 1; ctx.beginPath(); ctx.moveTo(x(s), top); ctx.lineTo(x(s), bottom); ctx.stroke();
      ring(ctx, x(s), y(2 * part.branch.radius[cursor.at]), 5, "#ffe14d", "#1a2230");
    }
    $("point").textContent = part ? this.said(part, cursor.at) : "Move along the curve to find a point in every drawing. Dashed: reference; circle: gravest narrowing; shaded: lesion.";
  }
  /** Write names above their parts: the number alone where there is no more room, the longest first. */
  names(ctx, middles, width) {
    ctx.fillStyle = tone("ink"); ctx.font = "600 12px system-ui, sans-serif"; ctx.textAlign = "left";
    const taken = [], rank = branch => branch.branch === this.store.chosen ? Infinity : branch.arc.at(-1);
    for (const [branch, middle] of [...middles].sort(([a], [b]) => rank(b) - rank(a))) {
      for (const text of [nameOf(branch), String(branch.branch)]) {
        const wide = ctx.measureText(text).width, left = Math.max(2, Math.min(width - 2 - wide, middle - wide / 2));
        if (taken.some(([a, b]) => left < b + 6 && a < left + wide + 6)) continue;
        taken.push([left, left + wide]);
        ctx.fillText(text, left, 12);
        break;
      }
    }
  }
  axes(ctx, { from, left, right, top, bottom, most, length, x, y }) {
    ctx.font = "12px system-ui, sans-serif"; ctx.fillStyle = tone("soft"); ctx.strokeStyle = tone("line"); ctx.lineWidth = 1;
    ctx.textAlign = "right"; ctx.textBaseline = "middle";
    for (let w = 0; w <= most; w += most > 5 ? 2 : 1) {
      ctx.beginPath(); ctx.moveTo(left, y(w)); ctx.lineTo(right, y(w)); ctx.stroke(); ctx.fillText(String(w), left - 6, y(w));
    }
    ctx.textAlign = "center"; ctx.textBaseline = "top";
    const stride = [5, 10, 20, 50, 100].find(t => length / t <= 8) || 200;
    for (let s = 0; s <= length; s += stride) ctx.fillText(String(s), x(s), bottom + 4);
    const up = "diameter, mm", free = right - 12 - ctx.measureText(up).width, whole = `mm ${from}`;
    ctx.textAlign = "right"; ctx.fillText(ctx.measureText(whole).width < free ? whole : whole.split(",")[0], right, bottom + 18);
    ctx.textAlign = "left"; ctx.fillText(up, 4, bottom + 18); ctx.textBaseline = "alphabetic";
  }
  said({ branch, start }, i) {
    const reference = branch.reference[i], sigma = branch.sigma[i];
    return `Branch ${nameOf(branch)}, ${(start + branch.arc[i]).toFixed(1)} mm ${from(branch)}: ${(2 * branch.radius[i]).toFixed(2)} mm` +
      (reference === null ? "" : `, reference ${(2 * reference).toFixed(2)} mm (${Math.max(0, Math.round(100 * (1 - branch.radius[i] / reference)))} % narrower)`) +
      (sigma === null ? "." : `, \u00b1 ${sigma.toFixed(2)} mm.`);
  }
}
