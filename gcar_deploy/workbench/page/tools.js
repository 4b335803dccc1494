// Tools that correct: each turns clicks and strokes into a change of the order.
import * as api from "./api.js";
import { $, el, label, ring } from "./dom.js";

export const TOOLS = [
  ["look", "Look", "V", "Drag to move, wheel to zoom; click a vessel to choose it."],
  ["erase", "Erase", "E", "Draw over what is no vessel: catheter, wire, rib."],
  ["paint", "Paint", "P", "Draw where a vessel is missing, in every view that shows it, as wide as it is."],
  ["cut", "Cut catheter", "C", "Click the catheter at both ends of the part to be cut; the line between is found."],
  ["region", "Region", "G", "Click the corners of what is to be looked at; double-click or Enter closes it."],
  ["landmark", "Landmark pair", "L", "Click a point (a fork, a kink) in one view, then the same in the other, on the dashed line."],
  ["same", "Same branch", "B", "Click a vessel in one view, then the same vessel in the other, at any place between its forks."],
  ["ostium", "Ostium", "O", "Click where the artery begins in one view, then in the other, on the dashed line."],
];
const round = point => point.map(x => Math.round(x * 10) / 10);
const KEYS = { landmark: "landmarks", same: "same_branch", ostium: "ostia" };
const INK = { erase: "#ff7a33", paint: "#56b4e9" };
/** Width of a coronary vessel, mm. */
const USUAL_MM = 2;
/** Points of one stroke of an order. */
const MOST = 2000;
/** A click this near to a crossing is put onto it, CSS pixels. */
const SNAP = 18;

export class Toolbox {
  constructor(store, say) {
    Object.assign(this, { store, say, name: "look", brush: 14, mm: 0, pictures: [] });
    this.clear();
    $("tool-buttons").replaceChildren(...TOOLS.map(([name, text, key, hint]) =>
      el("button", { type: "button", "aria-pressed": "false", "data-tool": name, title: `${hint} (${key})`, onclick: () => this.take(name) }, text)));
    $("brush").addEventListener("input", () => { this.wide(Number($("brush").value)); });
    this.take("look");
  }
  /** Strokes begin as wide as a vessel usually is, and are told by their width in the patient. */
  fit(views, anew) {
    this.mm = views.reduce((sum, view) => sum + view.pixel_mm, 0) / views.length || 0;
    this.wide(anew && this.mm ? Math.max(3, Math.min(60, Math.round(USUAL_MM / this.mm))) : this.brush);
  }
  wide(brush) {
    this.brush = $("brush").valueAsNumber = brush;
    $("brush-out").textContent = `${brush} px, ${(brush * this.mm).toFixed(1)} mm`;
  }
  /** Whether dragging draws a stroke. */
  get draws() { return this.name === "erase" || this.name === "paint"; }
  clear() { this.stroke = null; this.corners = null; this.first = null; this.mark = null; this.lines = []; }
  take(name) {
    this.name = name; this.clear();
    for (const button of $("tool-buttons").children) button.setAttribute("aria-pressed", String(button.dataset.tool === name));
    $("tool-hint").textContent = TOOLS.find(tool => tool[0] === name)[3];
    $("brush-label").hidden = !this.draws;
    this.redraw();
  }
  redraw() { this.pictures.forEach(picture => picture.draw()); }
  change(values) { return this.store.change(values).catch(error => this.say(error.message)); }

  down(picture, place) { this.stroke = { view: picture.number, points: [round(place)] }; }
  move(picture, place) {
    if (!this.stroke) return;
    const last = this.stroke.points.at(-1);
    if (Math.hypot(place[0] - last[0], place[1] - last[1]) > Math.max(1, this.brush / 6)) this.stroke.points.push(round(place));
  }
  up(picture, place) {
    const stroke = this.stroke;
    this.stroke = null;
    if (!stroke) return;
    stroke.points.push(round(place));
    const strokes = [];
    // Pieces share an end, so that no gap is left between them.
    for (let k = 0; k === 0 || k < stroke.points.length - 1; k += MOST - 1) strokes.push({ do: this.name, width_px: this.brush, points: stroke.points.slice(k, k + MOST) });
    this.add(stroke.view, ...strokes);
  }
  add(view, ...strokes) {
    const edits = this.store.now.edits ?? {};
    this.change({ edits: { ...edits, [view]: [...edits[view] ?? [], ...strokes] } });
  }

  /** A click that is no stroke; true where the tool takes it. */
  click(picture, place) {
    if (this.name === "look") return false;
    if (!picture.within(place)) return true;
    if (this.name === "cut") this.cut(picture, round(place));
    else if (this.name === "region") this.corner(picture, round(place));
    else this.pair(picture, place).catch(error => this.say(error.message));
    return true;
  }
  async cut(picture, place) {
    if (!this.first || this.first.view !== picture.number) {
      this.first = { view: picture.number, place };
      return this.redraw();
    }
    const from = this.first.place;
    this.first = null;
    try {
      const found = await api.post(`${this.store.path}/views/${picture.number}/trace`, { from, to: place });
      this.add(picture.number, { do: "erase", width_px: found.width_px, points: found.points });
    } catch (error) { this.say(error.message); }
  }
  corner(picture, place) {
    if (this.corners?.view !== picture.number) this.corners = { view: picture.number, points: [] };
    const last = this.corners.points.at(-1);
    if (!last || Math.hypot(last[0] - place[0], last[1] - place[1]) > 3) this.corners.points.push(place);
    this.redraw();
  }
  /** Close what is being marked. */
  finish(picture) {
    if (this.name === "region" && this.corners?.points.length > 2) {
      const regions = this.store.now.regions ?? {};
      const { view, points } = this.corners;
      this.corners = null;
      this.change({ regions: { ...regions, [view]: points } });
    } else if (this.mark && this.mark.filter(point => point).length > 1) this.keepMark();
    picture?.draw();
  }
  async pair(picture, place) {
    const k = picture.number - 1, views = this.store.info.views.length;
    const crossings = this.lines.find(line => line.view === picture.number)?.crossings ?? [];
    const near = crossings.map(p => [Math.hypot(p[0] - place[0], p[1] - place[1]) * picture.unit, p]).sort((a, b) => a[0] - b[0])[0];
    this.mark ??= Array(views).fill(null);
    this.mark[k] = round(near && near[0] < SNAP ? near[1] : place);
    const marked = this.mark.filter(point => point).length;
    if (marked === views) return this.keepMark();
    if (marked === 1 && this.name !== "same") {
      const found = await api.post(`${this.store.path}/views/${picture.number}/epipolar`, { point: this.mark[k] });
      this.lines = found.views;
    }
    this.redraw();
  }
  keepMark() {
    const key = KEYS[this.name];
    const mark = this.mark;
    this.mark = null; this.lines = [];
    return this.change({ [key]: [...this.store.now[key] ?? [], mark] });
  }

  draw(picture, ctx) {
    const view = picture.number, now = this.store.now, put = p => picture.put(p);
    for (const stroke of now.edits?.[view] ?? []) this.line(ctx, picture, stroke);
    if (this.stroke?.view === view) this.line(ctx, picture, { do: this.name, width_px: this.brush, points: this.stroke.points });
    const region = now.regions?.[view];
    if (region) this.outline(ctx, region.map(put), true);
    if (this.corners?.view === view) this.outline(ctx, this.corners.points.map(put), false);
    if (this.first?.view === view) ring(ctx, ...put(this.first.place), 5, "#fff");
    const line = this.lines.find(one => one.view === view);
    if (line?.line.length && !this.mark?.[view - 1]) this.epipolar(ctx, line, put);
    (now.landmarks ?? []).forEach((mark, k) => this.spot(ctx, mark[view - 1], `L${k + 1}`, put));
    (now.ostia ?? []).forEach((mark, k) => this.spot(ctx, mark[view - 1], `O${k + 1}`, put));
    (now.same_branch ?? []).forEach((mark, k) => this.spot(ctx, mark[view - 1], `B${k + 1}`, put));
    this.spot(ctx, this.mark?.[view - 1], this.name[0].toUpperCase(), put);
  }
  line(ctx, picture, stroke) {
    const at = stroke.points.map(p => picture.put(p));
    ctx.globalAlpha = 0.5; ctx.strokeStyle = ctx.fillStyle = INK[stroke.do];
    ctx.beginPath();
    at.forEach((p, i) => ctx[i ? "lineTo" : "moveTo"](...p));
    if (stroke.width_px === undefined) { ctx.closePath(); ctx.fill(); }
    else { if (at.length === 1) ctx.lineTo(...at[0]); ctx.lineWidth = stroke.width_px * picture.unit; ctx.stroke(); }
    ctx.globalAlpha = 1;
  }
  outline(ctx, at, closed) {
    for (const [wide, ink] of [[4, "#000"], [2, "#f0e442"]]) {
      ctx.lineWidth = wide; ctx.strokeStyle = ink; ctx.beginPath();
      at.forEach((p, i) => ctx[i ? "lineTo" : "moveTo"](...p));
      if (closed) ctx.closePath();
      ctx.stroke();
    }
    if (!closed) at.forEach(p => ring(ctx, ...p, 3, "#f0e442"));
  }
  epipolar(ctx, line, put) {
    ctx.setLineDash([8, 6]);
    for (const [wide, ink] of [[4, "#000a"], [2, "#f0e442"]]) {
      ctx.lineWidth = wide; ctx.strokeStyle = ink; ctx.beginPath();
      ctx.moveTo(...put(line.line[0])); ctx.lineTo(...put(line.line[1])); ctx.stroke();
    }
    ctx.setLineDash([]);
    line.crossings.forEach(p => ring(ctx, ...put(p), 6, "#f0e442"));
  }
  spot(ctx, place, text, put) {
    if (!place) return;
    const [x, y] = put(place);
    ring(ctx, x, y, 7, "#fff"); label(ctx, text, x + 10, y - 8);
  }
}
