// The tree in 3D, seen from the detector of a C-arm that is turned by dragging.
import { direction, el, gapAt, inside, label, nameOf, names, pen, ring, saved } from "./dom.js";

const rad = x => x * Math.PI / 180;
const dot = (p, q) => p[0] * q[0] + p[1] * q[1] + p[2] * q[2];
/** A colour made darker (light < 1), and mixed with white. */
function shade(color, light, white = 0) {
  const parts = color.match(/\d+/g).map(Number);
  return `rgb(${parts.map(x => Math.round(light * (x + (255 - x) * white))).join(",")})`;
}
const wrap = x => ((x + 180) % 360 + 360) % 360 - 180;
/** Directions that catheter laboratories use (primary, secondary). */
const STANDARD = [["AP", 0, 0], ["RAO caudal", -20, -20], ["RAO cranial", -10, 35], ["LAO cranial", 40, 25], ["Spider (LAO caudal)", 45, -30], ["Lateral", 90, 0]];

export class Scene3D {
  constructor(store) {
    this.store = store;
    this.canvas = el("canvas", { tabindex: 0, role: "img", "aria-label": "Tree in 3D; drag or use the arrow keys to turn it like a C-arm, plus and minus zoom" });
    this.title = el("div", { class: "title", "aria-live": "polite" });
    this.buttons = el("div", { class: "below" });
    const button = (text, name, act) => el("button", { type: "button", "aria-label": `${name} the tree`, title: name, onclick: act }, text);
    this.root = el("div", { class: "view" }, this.canvas, el("div", { class: "foot" }, this.title, el("div", { class: "zoom" },
      button("+", "Zoom in on", () => this.scale(1.3)), button("\u2212", "Zoom out of", () => this.scale(1 / 1.3)),
      button("\u2302", "Reset", () => this.reset()), button("\u2913", "Save picture of", () => saved(this.canvas, "tree.png")))), this.buttons);
    this.angles = [0, 0]; this.zoom = 1; this.shift = [0, 0]; this.kind = "branch";
    this.listen();
  }
  reset() { this.zoom = 1; this.shift = [0, 0]; this.draw(); }
  scale(factor) { this.zoom = Math.max(0.5, Math.min(12, this.zoom * factor)); this.draw(); }
  turn(primary, secondary) {
    this.angles = [wrap(this.angles[0] + primary), Math.max(-90, Math.min(90, this.angles[1] + secondary))];
    this.draw();
  }
  show(primary, secondary) { this.angles = [primary, secondary]; this.draw(); }

  /** Take a new result; the direction stays once there was one. */
  take() {
    const { scene, summary } = this.store.result;
    const all = scene.branches.flatMap(b => b.points);
    const ends = [0, 1, 2].map(k => all.reduce(([a, b], p) => [Math.min(a, p[k]), Math.max(b, p[k])], [Infinity, -Infinity]));
    const middle = ends.map(([a, b]) => all.length ? (a + b) / 2 : 0);
    if (!this.middle) this.angles = [...scene.views[0]];
    this.middle = middle;
    this.reach = all.reduce((most, p) => Math.max(most, Math.hypot(...p.map((x, k) => x - middle[k]))), 10);
    const views = summary.views.map((view, k) => [`View ${view.id}`, ...scene.views[k]]);
    if (summary.best_further_view) views.push(["Best further view", ...scene.views[summary.views.length]]);
    const standard = el("select", { "aria-label": "Standard views", onchange: e => e.target.value && this.show(...STANDARD[e.target.value].slice(1)) },
      el("option", { value: "" }, "Standard views"), ...STANDARD.map(([name], k) => el("option", { value: k }, name)));
    const colour = el("select", { "aria-label": "Colour of the tree", onchange: e => { this.kind = e.target.value; this.draw(); } },
      ...[["branch", "Colour: branch"], ["radius", "Colour: diameter"], ["sigma", "Colour: uncertainty"]].map(([value, text]) => el("option", { value, selected: value === this.kind }, text)));
    this.buttons.replaceChildren(...views.map(([name, a, b]) => el("button", { type: "button", onclick: () => this.show(a, b) }, name)), standard, colour);
  }

  listen() {
    const canvas = this.canvas;
    let from = null, moved = 0, pan = false;
    canvas.addEventListener("pointerdown", e => { from = [e.clientX, e.clientY]; moved = 0; pan = e.shiftKey || e.button > 0; canvas.setPointerCapture(e.pointerId); });
    canvas.addEventListener("pointermove", e => {
      if (!from) return;
      const step = [e.clientX - from[0], e.clientY - from[1]];
      moved += Math.hypot(...step); from = [e.clientX, e.clientY];
      if (pan) { this.shift = this.shift.map((s, k) => s + step[k]); this.draw(); } else this.turn(-0.4 * step[0], 0.4 * step[1]);
    });
    canvas.addEventListener("pointerup", e => { if (from && moved < 5) this.pick(inside(e, canvas)); from = null; });
    canvas.addEventListener("pointercancel", () => { from = null; });
    canvas.addEventListener("wheel", e => { e.preventDefault(); this.scale(Math.exp(-e.deltaY / 400)); }, { passive: false });
    canvas.addEventListener("keydown", e => {
      const step = { ArrowLeft: [5, 0], ArrowRight: [-5, 0], ArrowUp: [0, -5], ArrowDown: [0, 5] }[e.key];
      if (step) this.turn(...step);
      else if (e.key === "+" || e.key === "=") this.scale(1.25);
      else if (e.key === "-") this.scale(0.8);
      else if (e.key === "0") this.reset();
      else return;
      e.preventDefault();
    });
  }
  screen() {
    const [a, b] = this.angles.map(rad), width = this.canvas.clientWidth, height = this.canvas.clientHeight;
    const u = [Math.cos(a), Math.sin(a), 0];
    const v = [Math.sin(a) * Math.sin(b), -Math.cos(a) * Math.sin(b), -Math.cos(b)];
    const d = [Math.sin(a) * Math.cos(b), -Math.cos(a) * Math.cos(b), Math.sin(b)];
    const scale = 0.45 * Math.min(width, height) / this.reach * this.zoom;
    const centred = p => p.map((x, k) => x - this.middle[k]);
    const put = p => { const q = centred(p); return [width / 2 + this.shift[0] + scale * dot(q, u), height / 2 + this.shift[1] + scale * dot(q, v), dot(q, d)]; };
    return { u, v, scale, put };
  }
  pick([x, y]) {
    const { put } = this.screen();
    let found = 0, least = 18;
    for (const branch of this.store.result?.scene.branches ?? []) for (const p of branch.points) {
      const [px, py] = put(p), gap = Math.hypot(px - x, py - y);
      if (gap < least) { least = gap; found = branch.branch; }
    }
    if (found) this.store.choose(found);
  }
  draw() {
    const [ctx, width, height] = pen(this.canvas), { result, chosen, cursor } = this.store;
    ctx.fillStyle = "#0c1016"; ctx.fillRect(0, 0, width, height);
    this.title.replaceChildren(direction(...this.angles));
    if (!result || !this.middle) return;
    const { u, v, scale, put } = this.screen(), paint = this.paint(), pieces = [];
    for (const branch of result.scene.branches) {
      const at = branch.points.map(put);
      for (let i = 0; i + 1 < at.length; i++) if (!gapAt(branch, i)) pieces.push([(at[i][2] + at[i + 1][2]) / 2, at[i], at[i + 1], branch, i]);
    }
    // Nearest to the detector last: pictures are seen from there.
    pieces.sort((p, q) => p[0] - q[0]);
    for (const [depth, p, q, branch, i] of pieces) {
      const wide = Math.max(1.5, 2 * branch.radius[i] * scale);
      const stroke = (w, ink, cap) => { ctx.lineCap = cap; ctx.lineWidth = w; ctx.strokeStyle = ink; ctx.beginPath(); ctx.moveTo(p[0], p[1]); ctx.lineTo(q[0], q[1]); ctx.stroke(); };
      // Edges first, with flat ends, so that pieces of one vessel do not show.
      stroke(wide + (branch.branch === chosen ? 5 : 2), branch.branch === chosen ? "#fff" : "#000", "butt");
      const light = 0.55 + 0.45 * Math.max(0, Math.min(1, 0.5 + depth / this.reach / 2));
      stroke(wide, shade(paint(branch, i), light), "round");
      if (wide > 4) stroke(wide * 0.35, shade(paint(branch, i), light, 0.3), "round");
    }
    ctx.lineCap = "round";
    names(ctx, [...result.scene.branches].sort((a, b) => (b.branch === chosen) - (a.branch === chosen))
      .map(branch => [nameOf(branch), branch.points.map(put), "#fff"]));
    if (cursor) {
      const [x, y] = put(this.store.branch(cursor.branch).points[cursor.at]);
      ring(ctx, x, y, 7, "#ffe14d");
    }
    if (this.store.spot) ring(ctx, ...put(this.store.spot.place).slice(0, 2), 11, "#f0e442");
    this.compass(ctx, u, v, height);
    ctx.lineWidth = 2; ctx.strokeStyle = "#fff"; ctx.textAlign = "right";
    ctx.beginPath(); ctx.moveTo(width - 14, height - 14); ctx.lineTo(width - 14 - 20 * scale, height - 14); ctx.stroke();
    label(ctx, "20 mm", width - 14, height - 20); ctx.textAlign = "left";
    if (this.kind !== "branch" && this.limits) label(ctx, `${this.kind === "radius" ? "diameter" : "uncertainty"} ${this.limits[0].toFixed(1)} (blue) \u2013 ${this.limits[1].toFixed(1)} mm (yellow)`, 10, 62);
  }
  /** Colour of a piece; blue to yellow, which all kinds of colour vision tell apart. */
  paint() {
    const kind = this.kind, { scale, unknown } = this.store.result.scene;
    if (kind === "branch") return branch => branch.color;
    const factor = kind === "radius" ? 2 : 1;
    const all = this.store.result.scene.branches.flatMap(b => b[kind]).filter(x => x !== null).map(x => factor * x);
    this.limits = all.length ? [Math.min(...all), Math.max(...all)] : null;
    return (branch, i) => {
      const value = branch[kind][i];
      if (value === null || !this.limits) return unknown;
      const t = (factor * value - this.limits[0]) / (this.limits[1] - this.limits[0] || 1);
      return `rgb(${scale[0].map((x, k) => Math.round(x + (scale[1][k] - x) * t))})`;
    };
  }
  compass(ctx, u, v, height) {
    const x = 44, y = height - 44;
    ctx.lineWidth = 1.5; ctx.strokeStyle = "#cfd6e0"; ctx.textAlign = "center"; ctx.textBaseline = "middle";
    ["L", "P", "H"].forEach((letter, k) => {
      ctx.beginPath(); ctx.moveTo(x, y); ctx.lineTo(x + 22 * u[k], y + 22 * v[k]); ctx.stroke();
      label(ctx, letter, x + 32 * u[k], y + 32 * v[k], "#cfd6e0", 12);
    });
    ctx.textAlign = "left"; ctx.textBaseline = "alphabetic";
  }
}
