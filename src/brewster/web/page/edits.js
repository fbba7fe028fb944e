// The edits of the photos with their history, for undo and redo.
//
// An edit that changes several photos is one step: it has the same id in the histories of all of
// them, and is undone and redone in all of them.

const FIRST = { list: [], strength: 1, method: "auto", swap: null, step: null };

// The edits of a photo with their history: its marks, `list`; its strength, 0 to 1; for a burst the
// method, "auto" or "motion", and whether the layers are exchanged, `swap`: null until the user has
// decided; and the id of the `step` if the last edit has changed other photos, too, or null.
export class Edits {
  #states;
  #at;
  #isAdjusting = false;

  constructor({ states, at } = { states: [FIRST], at: 0 }) {
    this.#states = states;
    this.#at = at;
  }

  // The value for the constructor of a copy.
  get history() {
    return { states: this.#states, at: this.#at };
  }

  get now() {
    return this.#states[this.#at];
  }

  // The id of the step that `redo` repeats, or null.
  get nextStep() {
    return this.#states[this.#at + 1]?.step ?? null;
  }

  get list() {
    return this.now.list;
  }

  get strength() {
    return this.now.strength;
  }

  get canUndo() {
    return this.#at > 0;
  }

  get canRedo() {
    return this.#at < this.#states.length - 1;
  }

  add(mark) {
    this.change({ list: [...this.list, mark] });
  }

  change(values, step = null) {
    this.#states = [...this.#states.slice(0, this.#at + 1), { ...this.now, ...values, step }];
    this.#at = this.#states.length - 1;
    this.#isAdjusting = false;
  }

  // Changes values continuously: until `settle()`, all changes are one step of the history.
  adjust(values) {
    if (this.#isAdjusting) this.undo();
    this.change(values);
    this.#isAdjusting = true;
  }

  settle() {
    this.#isAdjusting = false;
  }

  undo() {
    this.#at = Math.max(0, this.#at - 1);
    this.#isAdjusting = false;
  }

  redo() {
    this.#at = Math.min(this.#states.length - 1, this.#at + 1);
  }
}

// Changes several photos in one step.
export function changeTogether(photos, values) {
  const step = crypto.getRandomValues(new Uint32Array(2)).join("-");
  for (const { edits } of photos) edits.change(values, step);
}

// Returns the photos in which the last edit of a photo is undone with it: this photo, and those
// that the same step changed, unless they were edited since.
export function photosOfLastStep(photos, photo) {
  const { step } = photo.edits.now;
  return photos.filter((one) => one === photo || (step && one.edits.now.step === step));
}

// Returns the photos in which the next edit of a photo is redone with it.
export function photosOfNextStep(photos, photo) {
  const step = photo.edits.nextStep;
  return photos.filter((one) => one === photo || (step && one.edits.nextStep === step));
}
