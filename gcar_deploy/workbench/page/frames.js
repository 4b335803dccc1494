// Frames of runs with what speaks for each: contrast and stillness.
import * as api from "./api.js";
import { $, el } from "./dom.js";

export async function frames(store, say) {
  const { dicom, views } = store.info;
  const runs = dicom.map((is, k) => is ? k : -1).filter(k => k >= 0);
  $("frames").hidden = !runs.length || !views.length;
  if ($("frames").hidden) return;
  const room = $("frames").querySelector("div"), shown = {};
  try {
    const strips = await Promise.all(runs.map(k => strip(store, say, k, shown)));
    room.replaceChildren(...strips);
  } catch (error) { say(error.message); }
}

function bar(kind, share) {
  const meter = el("span", { class: kind }, el("span", {}));
  meter.firstChild.style.width = `${Math.round(100 * share)}%`;
  return meter;
}
/** Scores of this run's frames with the frame that another view shows now; null where nobody judged pairs. */
function partner(store, told) {
  const [view, scores] = Object.entries(told.pairs)[0] ?? [];
  const frames = store.info.order.frames;
  const asked = view && frames && (frames.length === 1 ? frames[0] : frames[view - 1]);
  const now = asked ?? told.with?.[view];
  return now ? scores.map(row => row[now - 1]) : null;
}

async function strip(store, say, k, shown) {
  const path = `${store.path}/views/${k + 1}/frames`, told = await api.get(path);
  const order = store.info.order.frames;
  const asked = order && (order.length === 1 ? order[0] : order[k]);
  const now = shown[k] = asked ?? told.chosen;
  const with_ = partner(store, told);
  const near = new IntersectionObserver(seen => seen.filter(one => one.isIntersecting).forEach(async one => {
    near.unobserve(one.target);
    one.target.src = await api.imageUrl(`${path}/${one.target.dataset.frame}.png`);
  }), { rootMargin: "200px" });
  const buttons = told.filling.map((filling, i) => {
    const picture = el("img", { alt: "", "data-frame": i + 1 });
    near.observe(picture);
    const meter = bar("meter", filling), pair = with_ && bar("meter pair", with_[i]);
    return el("button", { type: "button", "aria-pressed": String(i + 1 === now),
      title: `Contrast ${Math.round(100 * filling)} %, motion ${Math.round(100 * told.motion[i])} % of the most${with_ ? `, with the other view's frame ${Math.round(100 * with_[i])} %` : ""}`,
      onclick: () => choose(store, say, k, i + 1, shown) }, picture, meter, pair, `${i + 1}${i + 1 === told.chosen ? " \u2605" : ""}`);
  });
  return el("div", {}, el("p", { class: "hint" }, `View ${k + 1}: frame ${now} of ${told.frames}${asked ? " (yours)" : ` (${told.reason})`}. Bar: contrast${with_ ? "; below: with the other view's frame" : ""}. \u2605: proposed.`),
    el("div", { class: "strip", tabindex: 0, role: "group", "aria-label": `Frames of view ${k + 1}` }, ...buttons));
}

/** Corrections that lie in the picture of view k, and what is left without them. */
function drawn(now, k) {
  const without = {};
  for (const key of ["edits", "regions"]) {
    const { [k + 1]: own, ...others } = now[key] ?? {};
    if (own) without[key] = others;
  }
  for (const key of ["landmarks", "same_branch", "ostia"]) {
    const others = (now[key] ?? []).filter(mark => !mark[k]);
    if (others.length < (now[key] ?? []).length) without[key] = others;
  }
  return without;
}

/** Take a frame. What was drawn on another one is no place in this: it goes, or the frame stays. */
async function choose(store, say, k, frame, shown) {
  if (frame === shown[k]) return;
  const now = store.now, gone = drawn(now, k);
  if (Object.keys(gone).length && !confirm(`Strokes and marks in view ${k + 1} were drawn on frame ${shown[k]}. Take frame ${frame} and discard them? Undo brings them back.`)) return;
  const before = now.frames ?? [null], runs = store.info.dicom.map((is, view) => is ? view : -1).filter(view => view >= 0);
  // Another run keeps the frame that was drawn on, which this choice might change.
  const all = runs.map((view, place) => view === k ? frame
    : (before.length === 1 ? before[0] : before[place]) ?? (Object.keys(drawn(now, view)).length ? shown[view] : null));
  try { await store.change({ frames: all, ...gone }); } catch (error) { say(error.message); }
}
