// The page: start, the case, and what connects its parts.
import * as api from "./api.js";
import { $, el, nameOf } from "./dom.js";
import { frames } from "./frames.js";
import { geometry, problem } from "./geometry.js";
import { Curve, more, table } from "./lumen.js";
import { Picture } from "./picture.js";
import { alternatives, corrections, files, status } from "./report.js";
import { Scene3D } from "./scene3d.js";
import { Store } from "./store.js";
import { Toolbox, TOOLS } from "./tools.js";

const store = new Store();
const look = { flat: false, found: true, tree: true, lens: false, width: 2 };
const tools = new Toolbox(store, say);
const curve = new Curve(store);
let pictures = [], scene = new Scene3D(store);

function say(text) {
  $("message").hidden = !text;
  $("message").textContent = store.words(text ?? "");
}
/** Do something that may fail; its error becomes a sentence. */
async function attempt(act) {
  say("");
  try { await act(); } catch (error) { say(error.message); }
}

async function start() {
  const desk = await api.get("/api/desk");
  document.querySelectorAll(".use").forEach(p => { p.textContent = desk.use; });
  const id = desk.cases.includes(api.asked) ? api.asked : desk.first;
  if (id) return open(await api.get(`/api/cases/${id}`));
  home(desk);
}
function home(desk) {
  api.address(null);
  $("start").hidden = false; $("case").hidden = true; $("case-tools").hidden = true; $("case-name").textContent = $("names").textContent = "";
  $("earlier").hidden = !desk.cases.length;
  $("cases").replaceChildren(...desk.cases.map(id => el("li", {}, el("button", { type: "button",
    onclick: () => attempt(async () => open(await api.get(`/api/cases/${id}`))) }, id))));
}

async function open(info) {
  api.address(info.id);
  $("start").hidden = true; $("case").hidden = false; $("case-tools").hidden = false;
  $("case-name").textContent = info.id; $("names").textContent = info.names.map((name, k) => `${k + 1}: ${name}`).join(", "); document.title = `${info.id} \u2013 gcar`;
  scene = new Scene3D(store);
  store.open(info);
  if (info.problem) ask();
  else await store.resume();
}
/** Say what the page must know before there can be a run, and show where it is asked for. */
function ask() {
  say(problem(store));
  $("geometry").open = true;
}
const run = () => attempt(async () => {
  if (!store.info.problem) return store.run();
  ask();
  $("geometry").scrollIntoView();
  $("geometry").querySelector("input")?.focus({ preventScroll: true });
});
async function send(list) {
  const body = new FormData();
  for (const file of list) body.append("file", file);
  await open(await api.post("/api/cases", body));
}

async function load() {
  const own = pictures;
  await Promise.all(own.map(async picture => {
    picture.image = await api.image(`${store.path}/views/${picture.number}/picture.png`);
    picture.draw();
  }));
}
/** Pictures without their background are made when they are first asked for. */
async function loadFlat() {
  await Promise.all(pictures.map(async picture => {
    picture.flat ??= await api.image(`${store.path}/views/${picture.number}/flat.png`);
    picture.draw();
  }));
}
async function loadFound() {
  await Promise.all(pictures.map(async picture => {
    picture.found = await api.image(`${store.path}/views/${picture.number}/found.png`);
    picture.draw();
  }));
}
function lay(anew = false) {
  pictures = store.info.views.map((_, k) => new Picture(store, k + 1, tools, look));
  tools.pictures = pictures; tools.clear(); tools.fit(store.info.views, anew);
  scene.root.hidden = !pictures.length;
  $("pictures").replaceChildren(...pictures.map(p => p.root), scene.root);
  $("tools").hidden = !pictures.length;
  attempt(load);
  if (look.flat) attempt(loadFlat);
  geometry(store, say); frames(store, say);
}
function draw() { pictures.forEach(p => p.draw()); scene.draw(); curve.draw(); }
function mark() {
  document.querySelectorAll("#lesions tbody tr").forEach(row => row.classList.toggle("chosen", Number(row.dataset.branch) === store.chosen));
}
function buttons() {
  $("undo").disabled = !store.canUndo; $("redo").disabled = !store.canRedo;
  $("run").classList.toggle("stale", store.stale && !store.running);
  $("run").hidden = store.running; $("cancel").hidden = !store.running;
}
/** Pick a stated alternative: what it adds to the corrections, and a new run. */
const pick = one => attempt(async () => {
  await store.change(Object.fromEntries(Object.entries(one.add).map(([key, more]) => [key, [...store.now[key] ?? [], ...more]])));
  await store.run();
});
/** Delete a branch: its middle names it in the order, whatever its number will be. */
const erase = branch => attempt(async () => {
  const gone = store.now.deleted_mm ?? [];
  // A second press while the first is under way names the same branch.
  if (gone.some(place => JSON.stringify(place) === JSON.stringify(branch.middle))) return;
  store.gone.set(JSON.stringify(branch.middle), nameOf(branch));
  store.choose(0);
  await store.change({ deleted_mm: [...gone, branch.middle] });
  await store.run();
});

store.addEventListener("opened", () => { lay(true); buttons(); status(store); corrections(store, say); $("lumen").hidden = true; $("files-of").hidden = true; $("alternatives").hidden = true; });
store.addEventListener("pictures", () => lay());
store.addEventListener("changed", () => {
  buttons(); status(store); corrections(store, say); draw();
  if (store.info.problem) ask();
});
store.addEventListener("progress", () => {
  buttons();
  const share = Math.round(100 * (store.job?.share ?? 0));
  $("progress").hidden = !store.running;
  $("progress").setAttribute("aria-valuenow", share);
  $("progress").setAttribute("aria-valuetext", `${store.job?.stage ?? ""} ${share} %`);
  $("progress").firstElementChild.style.width = `${share}%`;
  status(store);
});
store.addEventListener("finished", () => {
  const done = store.result !== null;
  $("lumen").hidden = !done; scene.root.hidden = !done;
  status(store); buttons(); files(store); alternatives(store, pick);
  if (done) { table(store, erase); scene.take(); curve.take(); mark(); }
  draw(); attempt(loadFound);
});
store.addEventListener("chosen", () => { mark(); curve.follow(); pictures.forEach(p => p.draw()); scene.draw(); });

$("demo").addEventListener("click", () => attempt(async () => open(await api.post("/api/demo"))));
$("files").addEventListener("change", e => attempt(() => send(e.target.files)));
$("more").addEventListener("click", () => { $("lesions").classList.toggle("all"); more(); });
$("home").addEventListener("click", () => attempt(async () => home(await api.get("/api/desk"))));
$("run").addEventListener("click", run);
$("cancel").addEventListener("click", () => attempt(() => store.cancel()));
$("undo").addEventListener("click", () => attempt(() => store.undo()));
$("redo").addEventListener("click", () => attempt(() => store.redo()));
for (const [id, key] of [["show-found", "found"], ["show-tree", "tree"], ["show-lens", "lens"], ["show-flat", "flat"]]) {
  $(id).addEventListener("change", () => { look[key] = $(id).checked; draw(); if (look.flat) attempt(loadFlat); });
}
$("line-width").addEventListener("input", () => { look.width = Number($("line-width").value); draw(); });
const drop = $("drop");
window.addEventListener("dragover", e => { e.preventDefault(); drop.classList.add("over"); });
window.addEventListener("dragleave", () => drop.classList.remove("over"));
window.addEventListener("drop", e => { e.preventDefault(); drop.classList.remove("over"); if (e.dataTransfer.files.length) attempt(() => send(e.dataTransfer.files)); });
window.addEventListener("resize", draw);
let closed = [];
window.addEventListener("beforeprint", () => {
  closed = [...document.querySelectorAll(".status .said:not([open])")];
  closed.forEach(list => { list.open = true; });
  $("printed").textContent = `printed ${new Date().toLocaleString("sv-SE").slice(0, 16)}`;
  draw();
});
window.addEventListener("afterprint", () => closed.forEach(list => { list.open = false; }));
for (const kind of ["print", "(prefers-color-scheme: dark)"]) window.matchMedia(kind).addEventListener("change", draw);

window.addEventListener("keydown", e => {
  if ($("case").hidden || e.target.matches("input, select")) return;
  const key = e.key.toLowerCase();
  if ((e.ctrlKey || e.metaKey) && key === "z") { e.preventDefault(); return attempt(() => e.shiftKey ? store.redo() : store.undo()); }
  if (e.ctrlKey || e.metaKey || e.altKey) return;
  const tool = TOOLS.find(([, , letter]) => letter.toLowerCase() === key);
  if (tool) tools.take(tool[0]);
  else if (key === "r") run();
  else if (key === "escape") tools.take("look");
  else if (key === "enter" && tools.corners) tools.finish(null);
  else if (key === "h") { $("show-tree").click(); }
  else if (key === "delete" && store.picked) erase(store.picked);
  else if (key === "delete" && store.result) say("Delete acts on a branch that you chose: click one first.");
});

attempt(start);
