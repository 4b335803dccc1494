// One angiogram: picture, vessels found, strokes, marks and the tree over it; zoom and pan.
import { el, gapAt, inside, nameOf, names, pen, ring, saved } from "./dom.js";

const LENS = 70;

export class Picture {
  /** store: Store; number: of the view, from 1; tools: Toolbox; look: what is shown. */
  constructor(store, number, tools, look) {
    Object.assign(this, { store, number, tools, look, image: null, flat: null, found: null, hover: null, cross: null });
    this.zoom = 1; this.shift = [0, 0]; this.from = null; this.moved = 0;
    const info = store.info.views[number - 1];
    this.canvas = el("canvas", { tabindex: 0, role: "img", "aria-label": `View ${info.id}, ${info.name}: the picture with the tree; arrow keys move, plus and minus zoom` });
    this.title = el("div", { class: "title" });
    const button = (text, name, act) => el("button", { type: "button", "aria-label": `${name} view ${info.id}`, title: name, onclick: act }, text);
    this.root = el("div", { class: "view" }, this.canvas, el("div", { class: "foot" }, this.title, el("div", { class: "zoom" },
      button("+", "Zoom in", () => this.scale(1.4)), button("\u2212", "Zoom out", () => this.scale(1 / 1.4)),
      button("\u2302", "Reset", () => this.reset()), button("\u2913", "Save picture of", () => saved(this.canvas, `view${number}.png`)))));
    this.listen();
  }

  get size() { const v = this.store.info.views[this.number - 1]; return [v.columns, v.rows]; }
  /** CSS pixels of one pixel of the picture. */
  get unit() {
    const [columns, rows] = this.size;
    return Math.min(this.canvas.clientWidth / columns, this.canvas.clientHeight / rows) * this.zoom;
  }
  // A pixel's middle is a whole number; its corner lies half a pixel before it.
  put([c, r]) {
    const [columns, rows] = this.size, k = this.unit;
    return [this.canvas.clientWidth / 2 + (c + 0.5 - columns / 2) * k + this.shift[0],
            this.canvas.clientHeight / 2 + (r + 0.5 - rows / 2) * k + this.shift[1]];
  }
  at([x, y]) {
    const [columns, rows] = this.size, k = this.unit;
    return [(x - this.shift[0] - this.canvas.clientWidth / 2) / k + columns / 2 - 0.5,
            (y - this.shift[1] - this.canvas.clientHeight / 2) / k + rows / 2 - 0.5];
  }
  within([c, r]) { const [columns, rows] = this.size; return c >= 0 && r >= 0 && c < columns && r < rows; }

  scale(factor, around = [this.canvas.clientWidth / 2, this.canvas.clientHeight / 2]) {
    const fixed = this.at(around);
    this.zoom = Math.max(1, Math.min(16, this.zoom * factor));
    const now = this.put(fixed);
    this.shift = this.zoom === 1 ? [0, 0] : this.shift.map((s, k) => s + around[k] - now[k]);
    this.draw();
  }
  reset() { this.zoom = 1; this.shift = [0, 0]; this.draw(); }

  listen() {
    const canvas = this.canvas;
    canvas.addEventListener("wheel", e => { e.preventDefault(); this.scale(Math.exp(-e.deltaY / 400), inside(e, canvas)); }, { passive: false });
    canvas.addEventListener("pointerdown", e => {
      canvas.setPointerCapture(e.pointerId);
      this.from = [e.clientX, e.clientY]; this.moved = 0; this.cross = null;
      this.panning = e.button === 1 || !this.tools.draws;
      if (!this.panning) this.tools.down(this, this.at(inside(e, canvas)));
    });
    canvas.addEventListener("pointermove", e => {
      this.hover = inside(e, canvas);
      if (this.from) {
        const step = [e.clientX - this.from[0], e.clientY - this.from[1]];
        this.moved += Math.hypot(...step);
        this.from = [e.clientX, e.clientY];
        if (this.panning) this.shift = this.shift.map((s, k) => s + step[k]);
        else this.tools.move(this, this.at(this.hover));
      }
      this.draw();
    });
    canvas.addEventListener("pointerup", e => {
      const place = this.at(inside(e, canvas));
      if (this.from && !this.panning) this.tools.up(this, place);
      else if (this.from && this.moved < 5) this.click(place);
      this.from = null; this.draw();
    });
    canvas.addEventListener("pointercancel", () => { this.from = null; });
    canvas.addEventListener("pointerleave", () => { this.hover = null; this.draw(); });
    canvas.addEventListener("dblclick", e => { e.preventDefault(); this.tools.finish(this); });
    canvas.addEventListener("keydown", e => this.key(e));
  }
  click(place) {
    if (!this.tools.click(this, place)) this.choose(place);
  }
  key(e) {
    const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[e.key];
    if (step && this.tools.name === "look") this.shift = this.shift.map((s, k) => s - 30 * step[k]);
    else if (step) {
      const [columns, rows] = this.size, by = e.shiftKey ? 1 : 5;
      this.cross ??= [columns / 2, rows / 2];
      this.cross = this.cross.map((x, k) => Math.max(0, Math.min(this.size[k] - 1, x + by * step[k])));
    } else if (e.key === "Enter" && this.cross) {
      if (this.tools.draws) { this.tools.down(this, this.cross); this.tools.up(this, this.cross); }
      else this.click(this.cross);
    } else if (e.key === "+" || e.key === "=") this.scale(1.25);
    else if (e.key === "-") this.scale(0.8);
    else if (e.key === "0") this.reset();
    else return;
    e.preventDefault(); this.draw();
  }
  choose(place) {
    let found = 0, least = 14 / this.unit;
    for (const branch of this.store.result?.scene.branches ?? []) {
      for (const p of this.line(branch)) {
        const gap = Math.hypot(p[0] - place[0], p[1] - place[1]);
        if (gap < least) { least = gap; found = branch.branch; }
      }
    }
    if (found) this.store.choose(found);
  }
  /** Places of a branch in the picture, pixels. */
  line(branch) {
    const [columns, rows] = this.size, places = this.store.result.scene.places;
    return branch.seen[this.number - 1].at.map(([x, y]) => [x / places * columns - 0.5, y / places * rows - 0.5]);
  }

  draw() {
    const [ctx, width, height] = pen(this.canvas), info = this.store.info.views[this.number - 1];
    ctx.fillStyle = "#0c1016"; ctx.fillRect(0, 0, width, height);
    const corner = this.put([-0.5, -0.5]), k = this.unit, [columns, rows] = this.size;
    ctx.imageSmoothingEnabled = k < 3;
    const lay = picture => picture && ctx.drawImage(picture, ...corner, columns * k, rows * k);
    lay(this.look.flat ? this.flat ?? this.image : this.image);
    ctx.save();
    if (this.look.lens && this.hover) {
      ctx.beginPath(); ctx.rect(0, 0, width, height);
      ctx.arc(...this.hover, LENS, 0, 2 * Math.PI, true); ctx.clip();
    }
    if (this.look.found) { ctx.globalAlpha = this.store.result && this.look.tree ? 0.45 : 1; lay(this.found); ctx.globalAlpha = 1; }
    if (this.store.result && this.look.tree) this.tree(ctx);
    ctx.restore();
    this.tools.draw(this, ctx);
    if (this.cross) this.crosshair(ctx);
    if (this.tools.draws && this.hover) ring(ctx, ...this.hover, Math.max(2, this.tools.brush / 2 * k), "#fff");
    const share = this.store.result?.summary.views[this.number - 1] ?? {}, percent = value => `${Math.round(100 * value)} %`;
    this.title.replaceChildren(`${info.id}: ${info.name}`, el("small", {}, [
      share.coverage_even != null ? `${percent(share.coverage_even)} of the length explained (${percent(share.coverage)} weighed by thickness)` : "",
      this.frame()].filter(t => t).join(" \u00b7 ")));
  }
  frame() {
    const frames = this.store.info.order.frames;
    if (!this.store.info.dicom[this.number - 1]) return "";
    const one = frames && (frames.length === 1 ? frames[0] : frames[this.number - 1]);
    return one ? `frame ${one}` : "";
  }
  tree(ctx) {
    const { store } = this, scene = store.result.scene;
    const lines = scene.branches.map(b => [b, this.line(b).map(p => this.put(p))]);
    const draw = (branch, at, wide, ink) => {
      ctx.lineWidth = wide; ctx.strokeStyle = ink; ctx.beginPath();
      at.forEach((p, i) => ctx[i && !gapAt(branch, i) ? "lineTo" : "moveTo"](...p)); ctx.stroke();
    };
    const wide = this.look.width;
    for (const [branch, at] of lines) draw(branch, at, wide + 2.5, "#000b");
    for (const [branch, at] of lines) {
      const chosen = branch.branch === store.chosen;
      draw(branch, at, chosen ? wide + 1.5 : wide, branch.color);
    }
    names(ctx, [...lines].sort(([a], [b]) => (b.branch === store.chosen) - (a.branch === store.chosen))
      .map(([branch, at]) => [nameOf(branch), at, branch.branch === store.chosen ? "#fff" : branch.color]));
    if (store.spot) ring(ctx, ...this.put(store.spot.at[this.number - 1]), 11, "#f0e442");
    const cursor = store.cursor && lines.find(([b]) => b.branch === store.cursor.branch);
    if (cursor) ring(ctx, ...cursor[1][store.cursor.at], 6, "#ffe14d");
  }
  crosshair(ctx) {
    const [x, y] = this.put(this.cross);
    for (const [wide, ink] of [[3, "#000"], [1.2, "#fff"]]) {
      ctx.lineWidth = wide; ctx.strokeStyle = ink; ctx.beginPath();
      ctx.moveTo(x - 14, y); ctx.lineTo(x + 14, y); ctx.moveTo(x, y - 14); ctx.lineTo(x, y + 14); ctx.stroke();
    }
  }
}
