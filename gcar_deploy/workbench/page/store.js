// The case on the page: what the server says of it, its corrections with undo, its result.
import * as api from "./api.js";

// What is undone and redone: keys of the order that the page changes.
const KEYS = ["edits", "regions", "landmarks", "same_branch", "ostia", "deleted_mm", "frames", "geometry"];
const corrections = order => Object.fromEntries(KEYS.map(key => [key, order[key] ?? null]));
const same = (a, b) => JSON.stringify(a) === JSON.stringify(b);

export class Store extends EventTarget {
  info = null; result = null; job = null; running = false;
  chosen = 0; cursor = null; spot = null; ran = null; #past = []; #future = []; #runs = 0; #last = Promise.resolve();

  get path() { return `/api/cases/${this.info.id}`; }
  get now() { return corrections(this.info.order); }
  get canUndo() { return this.#past.length > 0; }
  get canRedo() { return this.#future.length > 0; }
  /** Whether the result was made without the corrections of now. */
  get stale() { return this.ran !== null && !same(this.ran, this.now); }

  tell(what) { this.dispatchEvent(new Event(what)); }

  open(info) {
    this.#runs++; this.running = false;
    Object.assign(this, { info, result: null, job: null, ran: null, chosen: 0, cursor: null, spot: null });
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
      return !same(before.deleted_mm, after.deleted_mm) || !same(before.ostia, after.ostia);
    });
    // Only a new run shows what becomes of a tree; strokes are seen at once.
    if (again) await this.run();
  }

  async #send(values) {
    const geometry = !same(values.geometry, this.now.geometry), frames = !same(values.frames, this.now.frames);
    this.info = await api.put(`${this.path}/order`, values);
    if (geometry || frames) this.tell("pictures");
  }

  async run() {
    if (this.running) await this.cancel();
    const asked = this.now, path = this.path, own = ++this.#runs;
    this.running = true;
    this.tell("progress");
    try {
      const begun = this.job = await api.post(`${path}/run`);
      const done = await api.follow(begun, job => {
        if (own === this.#runs) { this.job = job; this.tell("progress"); }
      });
      const result = done.state === "done" ? await api.get(`${path}/result`) : null;
      // A later run, or another case, has taken over.
      if (own !== this.#runs) return;
      Object.assign(this, { ran: asked, result });
      if (this.result) {
        const branches = this.result.scene.branches;
        this.chosen = branches.some(b => b.branch === this.chosen) ? this.chosen : worst(branches);
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

  choose(branch) { this.chosen = branch; this.cursor = this.spot = null; this.tell("chosen"); }
  /** A point of a branch that all drawings mark: its number and the place in its list. */
  point(cursor) { this.cursor = cursor; this.tell("chosen"); }
  /** A stated alternative, whose place all drawings mark. */
  show(spot) { if (spot.branches.length) this.chosen = spot.branches[0]; this.cursor = null; this.spot = spot; this.tell("chosen"); }
  branch(number) { return this.result?.scene.branches.find(b => b.branch === number) ?? null; }
}

/** The branch to begin with: the one with the most severe narrowing. */
function worst(branches) {
  const ranked = [...branches].sort((a, b) => (b.stenosis ?? -1) - (a.stenosis ?? -1));
  return ranked.length ? ranked[0].branch : 0;
}
