// Draws marks on <glass-compare> with a pointer or with the keyboard. Their tint (tint.js) is
// visible while the pointer or the keyboard cursor is on the photo; a finger that is lifted leaves
// it visible.

import { Tint } from "./tint.js";

const KEY_STEP = 0.01; // of the longer side of the photo; five times as much with Shift
// minimum distance of the points of a stroke, as a fraction of the brush radius
const MIN_STEP = 0.2;

export class MarkEditor {
  isActive = false;
  #drawn = null; // the mark that is being drawn
  // position of the pointer or of the keyboard cursor, in fractions of the longer side
  #cursor = null;
  #isTintVisible = true;
  #tint = new Tint();

  // `tool()` returns {shape, kind, radius, feather} of the next mark. `onChange()` is called when
  // `list` or the cursor has changed, `onStart()` when a mark begins, `onAdd(mark)` with each
  // finished mark, and `announce(text)` to tell screen readers what happened.
  constructor({ tool, onChange, onStart, onAdd, announce }) {
    Object.assign(this, { tool, onChange, onStart, onAdd, announce });
    this.edits = null; // the Edits of the current photo
    this.size = [1, 1]; // width and height of the photo
  }

  // All marks, including the mark that is being drawn.
  get list() {
    const list = this.edits?.list ?? [];
    return this.#drawn ? [...list, this.#drawn] : list;
  }

  // Shows the tint of the hints until `fadeHints`.
  showHints() {
    this.#tint.showHints();
    this.onChange();
  }

  // Lets the tint of the hints disappear, unless a mark is being drawn.
  fadeHints() {
    if (!this.#drawn) this.#tint.fadeHints(this.onChange);
  }

  start(point) {
    const { shape, ...rest } = this.tool();
    this.#tint.showHints();
    this.onStart();
    this.#cursor = point;
    this.#drawn = { shape, ...rest, points: shape === "rectangle" ? [point, point] : [point] };
    this.onChange();
  }

  move(point) {
    this.#cursor = point;
    if (!this.#drawn) return;
    const { shape, points, radius } = this.#drawn;
    const [x, y] = points.at(-1);
    if (shape === "brush" && Math.hypot(point[0] - x, point[1] - y) < MIN_STEP * radius) return;
    this.#drawn = {
      ...this.#drawn,
      points: shape === "rectangle" ? [points[0], point] : [...points, point],
    };
    this.onChange();
  }

  end() {
    const mark = this.#drawn;
    this.#drawn = null;
    if (mark && isVisible(mark)) this.onAdd(mark);
    else this.onChange();
  }

  cancel() {
    if (!this.#drawn) return;
    this.#drawn = null;
    this.onChange();
  }

  // Moves the cursor, or hides it if `point` is null.
  hover(point, isTintVisible = true) {
    this.#cursor = point;
    this.#isTintVisible = isTintVisible;
    this.onChange();
  }

  // Handles a key: arrows move the cursor, space or Enter starts and ends a mark, Escape cancels
  // it. Returns whether the key was handled.
  press(event) {
    const step = KEY_STEP * (event.shiftKey ? 5 : 1);
    const steps = {
      ArrowLeft: [-step, 0],
      ArrowRight: [step, 0],
      ArrowUp: [0, -step],
      ArrowDown: [0, step],
    };
    const longer = Math.max(...this.size);
    const ends = this.size.map((side) => side / longer);
    this.#cursor ??= ends.map((end) => end / 2);
    if (event.key in steps) {
      this.move(
        this.#cursor.map((at, i) => Math.min(ends[i], Math.max(0, at + steps[event.key][i]))),
      );
      this.onChange();
    } else if (event.key === " " || event.key === "Enter") {
      const isEnd = this.#drawn !== null;
      isEnd ? this.end() : this.start(this.#cursor);
      this.announce(
        isEnd
          ? "The mark ends."
          : "The mark begins. Move with the arrow keys, and press space again to end it.",
      );
    } else if (event.key === "Escape" && this.#drawn) this.cancel();
    else return false;
    return true;
  }

  // Draws the tint and the cursor above an image at `origin` with `size`, in screen pixels.
  paint(context, origin, size) {
    if (!this.isActive) return;
    if (this.list.length && (this.#cursor || this.#isTintVisible)) {
      const areHintsShown = this.tool().kind === "erase"; // so that one sees what can be erased
      this.#tint.paint(context, this.list, this.size, origin, size, areHintsShown);
    }
    if (!this.#cursor) return;
    const longer = Math.max(size.width, size.height);
    const [x, y] = [origin.x + this.#cursor[0] * longer, origin.y + this.#cursor[1] * longer];
    const { shape, radius } = this.tool();
    for (const [style, width] of [
      ["#000", 3],
      ["#fff", 1.5],
    ]) {
      context.beginPath();
      context.lineWidth = width;
      context.strokeStyle = style;
      if (shape === "brush") context.arc(x, y, Math.max(2, radius * longer), 0, 2 * Math.PI);
      else {
        context.moveTo(x - 12, y);
        context.lineTo(x + 12, y);
        context.moveTo(x, y - 12);
        context.lineTo(x, y + 12);
      }
      context.stroke();
    }
  }
}

const isVisible = ({ shape, points }) =>
  shape === "brush" || points[0].some((at, i) => Math.abs(at - points[1][i]) > 1e-3);
