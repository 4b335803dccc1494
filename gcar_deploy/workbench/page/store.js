// The case on the page: what the server says of it, its corrections with undo, its result.
import * as api from "./api.js";

// What is undone and redone: keys of the order that the page changes.
const KEYS = ["edits", "regions", "landmarks", "same_branch", "ostia", "deleted_mm", "frames", "geometry", "pixel_spacing_mm", "sod_mm"];
/** Of these, what the pictures are read by. */
const READING = ["frames", "geometry", "pixel_spacing_mm", "sod_mm"];
const corrections = order => Object.fromEntries(KEYS.map(key => [key, order[key] ?? null]));
/** A branch of a new result is an earlier one where their middles lie so near, mm. */
const SAME_MM = 5;
const same = (a, b) => JSON.stringify(a) === JSON.stringify(b);

export class Store extends EventTarget {
  /** Place of a deleted branch -> the name that it had. */
  gone = new Map();
  info = null; result = null; job = null; running = false;
  chosen = 0; cursor = null; spot = null; ran = null; #past = []; #future = []; #runs = 0; #picked = false; #last = Promise.resolve();

  get path() { return `/api/cases/${this.info.id}`; }
  get now() { return corrections(this.info.order); }
  get canUndo() { return this.#past.length > 0; }
  get canRedo() { return this.#future.length > 0; }
  /** Whether the result was made without the corrections of now. */
  get stale() { return this.ran !== null && !same(this.ran, this.now); }
  /** The chosen branch where the user chose it, null where the page did: what Delete may act on. */
  get picked() { return this.#picked ? this.branch(this.chosen) : null; }

  /** A sentence with the names that the user's files had. */
  words(text) {
    const stored = this.info?.order.views.map(path => path.split(/[\\/]/).at(-1)) ?? [];
    const any = stored.map(name => name.replace(/[^\w]/g, "\\$&")).join("|");
    return text && any ? text.replace(new RegExp(any, "g"), name => this.info.names[stored.indexOf(name)]) : text;
  }
  tell(what) { this.dispatchEvent(new Event(what)); }

  open(info) {
    this.#runs++; this.running = this.#picked = false;
    Object.assign(this, { info, result: null, job: null, ran: null, chosen: 0, cursor: null, spot: null, told: info.order.geometry ?? null });
    this.#past.length = 0; this.#future.length = 0;
    this.tell("opened");
  }

  /** Change corrections; what comes of it can be undone. */
  change(values) {
    return this.#inTurn(async () => {
      const before = this.now;
      await this.#send({ ...before, ...values });
      this.#past.push(before); this.#future.length = 0;
      this.tell("changed");
    });
  }

  /** One change after the other: a second undo must not find the first half done. */
  #inTurn(work) {
    const own = this.#last.then(work);
    this.#last = own.catch(() => {});
    return own;
  }

  async undo() { await this.#step(this.#past, this.#future); }
  async redo() { await this.#step(this.#future, this.#past); }

  async #step(from, to) {
    const again = await this.#inTurn(async () => {
      if (!from.length) return false;
      const before = this.now, after = from.at(-1);
      await this.#send(after);
      from.pop(); to.push(before);
      this.tell("changed");
      return ["deleted_mm", "ostia", "same_branch"].some(key => !same(before[key], after[key]));
    });
    // Only a new run shows what becomes of a tree; strokes are seen at once.
    if (again) await this.run();
  }

  /** Send what differs; the server refuses where somebody else has corrected the case since. */
  async #send(values) {
    const now = this.now, changed = Object.fromEntries(Object.entries(values).filter(([key, value]) => !same(value, now[key])));
    try {
      this.info = await api.put(`${this.path}/order`, { ...changed, revision: this.info.revision });
    } catch (error) {
      await this.#refresh();
      throw error;
    }
    if (READING.some(key => key in changed)) this.tell("pictures");
  }
  /** Show the case as the server has it; what was undone before belongs to another one. */
  async #refresh() {
    const info = await api.get(this.path).catch(() => null);
    if (!info || info.revision === this.info.revision) return;
    this.info = info;
    this.#past.length = 0; this.#future.length = 0;
    this.tell("pictures"); this.tell("changed");
  }

  /** Show what this session has made of the case, or follow the run that is under way; else run. */
  async resume() {
    const { info } = this, opened = this.#runs;
    const job = info.job && await api.get(`/api/jobs/${info.job}`).catch(() => null);
    const result = info.result ? await api.get(`${this.path}/result`) : null;
    if (opened !== this.#runs) return;
    if (result) {
      Object.assign(this, { job, result, ran: info.stale ? {} : this.now, chosen: worst(result.scene.branches) });
      this.tell("finished");
    }
    const under_way = ["queued", "running"].includes(job?.state);
    if (under_way || !result) await this.run(under_way || ["refused", "failed"].includes(job?.state) ? job : null);
  }

  /** Run the case, or follow a run of it that was begun. */
  async run(known = null) {
    if (this.running) await this.cancel();
    const asked = known && this.info.since ? {} : this.now, path = this.path, own = ++this.#runs, chosen = this.branch(this.chosen);
    this.running = true;
    this.tell("progress");
    try {
      const begun = this.job = known ?? await api.post(`${path}/run`);
      const done = await api.follow(begun, job => {
        if (own === this.#runs) { this.job = job; this.tell("progress"); }
      });
      const result = done.state === "done" ? await api.get(`${path}/result`) : null;
      // A later run, or another case, has taken over.
      if (own !== this.#runs) return;
      // A cancelled run says nothing: what was there before stays.
      if (done.state !== "cancelled") {
        const before = this.result;
        Object.assign(this, { ran: asked, result });
        // Branches are numbered anew: the chosen one is known by its place. What was deleted
        // leaves none chosen, so that no second key deletes another.
        if (result) this.chosen = before ? again(result.scene.branches, chosen) : worst(result.scene.branches);
        this.#picked &&= before !== null;
        this.cursor = this.spot = null;
      }
      this.tell("finished");
    } finally {
      if (own === this.#runs) {
        this.running = false;
        this.tell("progress");
      }
    }
  }

  async cancel() {
    if (this.job && this.running) await api.remove(`/api/jobs/${this.job.id}`);
  }

  choose(branch) { this.chosen = branch; this.#picked = true; this.cursor = this.spot = null; this.tell("chosen"); }
  /** A point of a branch that all drawings mark: its number and the place in its list. */
  point(cursor) { this.cursor = cursor; this.tell("chosen"); }
  /** A stated alternative, whose place all drawings mark. */
  show(spot) {
    if (spot.branches.length) { this.chosen = spot.branches[0]; this.#picked = false; }
    this.cursor = null; this.spot = spot; this.tell("chosen");
  }
  branch(number) { return this.result?.scene.branches.find(b => b.branch === number) ?? null; }
}

/** The branch that runs where a chosen one did; 0 where none does, or none was chosen. */
function again(branches, chosen) {
  if (!chosen) return 0;
  const gap = b => Math.hypot(...b.middle.map((x, k) => x - chosen.middle[k]));
  const near = [...branches].sort((a, b) => gap(a) - gap(b))[0];
  return near && gap(near) < SAME_MM ? near.branch : 0;
}

/** The branch to begin with: the one with the most severe narrowing. */
function worst(branches) {
  const ranked = [...branches].sort((a, b) => (b.stenosis ?? -1) - (a.stenosis ?? -1));
  return ranked.length ? ranked[0].branch : 0;
}
