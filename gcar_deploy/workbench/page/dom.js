// Small helpers for elements and canvases.
export const $ = id => document.getElementById(id);

/** Make an element: attributes and listeners (on...) from an object, then children. */
export function el(name, attributes = {}, ...children) {
  const made = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (key.startsWith("on")) made.addEventListener(key.slice(2), value);
    else if (key === "class") made.className = value;
    else if (value === true) made.setAttribute(key, "");
    else if (value !== false && value !== null && value !== undefined) made.setAttribute(key, value);
  }
  made.append(...children.flat().filter(child => child !== null && child !== undefined));
  return made;
}

/** A colour of the page as it is now: light, dark or on paper. */
export const tone = name => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`);

/** Context of a canvas in CSS pixels, sharp on any screen, with its width and height. */
export function pen(canvas) {
  const ratio = window.devicePixelRatio || 1;
  const width = canvas.clientWidth, height = canvas.clientHeight;
  const wide = Math.round(width * ratio), high = Math.round(height * ratio);
  if (canvas.width !== wide || canvas.height !== high) { canvas.width = wide; canvas.height = high; }
  const ctx = canvas.getContext("2d");
  ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
  ctx.clearRect(0, 0, width, height);
  ctx.lineCap = ctx.lineJoin = "round";
  return [ctx, width, height];
}

/** Keep what a canvas shows as a picture. */
export function saved(canvas, name) {
  canvas.toBlob(blob => {
    const link = el("a", { href: URL.createObjectURL(blob), download: name });
    link.click(); URL.revokeObjectURL(link.href);
  });
}

export function inside(event, target) {
  const box = target.getBoundingClientRect();
  return [event.clientX - box.left, event.clientY - box.top];
}

const FONT = size => `600 ${size}px system-ui, sans-serif`;
/** Text that is readable on any picture. */
export function label(ctx, text, x, y, color = "#fff", size = 13) {
  ctx.font = FONT(size);
  ctx.lineWidth = 3.5; ctx.strokeStyle = "#000"; ctx.strokeText(text, x, y);
  ctx.fillStyle = color; ctx.fillText(text, x, y);
}

/** Write names beside lines: whole, at a place of each where no other stands, the first lines first. */
export function names(ctx, lines) {
  const taken = [], { clientWidth: width, clientHeight: height } = ctx.canvas, high = 14;
  ctx.font = FONT(13);
  for (const [text, at, color] of lines) {
    const wide = ctx.measureText(text).width;
    // What begins at the border has its name within it; what is outside has none.
    const free = [0.5, 0.3, 0.7, 0.85, 0.15].map(share => at[Math.floor(share * (at.length - 1))])
      .filter(([x, y]) => x >= 0 && y >= 0 && x <= width && y <= height)
      .map(([x, y]) => [Math.min(x + 7, width - wide - 3), Math.max(y - 5, high)])
      .find(([x, y]) => taken.every(([px, py, far]) => x > far + 5 || px > x + wide + 5 || Math.abs(py - y) > high));
    if (!free) continue;
    taken.push([...free, free[0] + wide]);
    label(ctx, text, ...free, color);
  }
}

export function ring(ctx, x, y, radius, color, dark = "#000") {
  for (const [wide, ink] of [[5, dark], [2.2, color]]) {
    ctx.lineWidth = wide; ctx.strokeStyle = ink;
    ctx.beginPath(); ctx.arc(x, y, radius, 0, 2 * Math.PI); ctx.stroke();
  }
}

/** Name of a branch: its number, and its vessel where anatomy tells it. */
export const nameOf = branch => branch.name ? `${branch.branch} ${branch.name}` : String(branch.branch);

/** Whether a place of a branch is left out, so that what is probably a ghost is dashed. */
export const gapAt = (branch, i) => (branch.ghost?.[i] ?? 0) >= 0.5 && Math.floor(branch.arc[i] / 1.5) % 2 === 1;

/** Clinical name of a direction. */
export function direction(primary, secondary) {
  const a = Math.round(primary), b = Math.round(secondary);
  return `${a < 0 ? "RAO" : "LAO"} ${Math.abs(a)}\u00b0 ${b < 0 ? "CAU" : "CRA"} ${Math.abs(b)}\u00b0`;
}
