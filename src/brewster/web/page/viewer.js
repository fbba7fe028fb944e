// The pictures of the current photo: the comparison with its tiles, the marks, and the question
// which of two measured layers is behind the glass.

import { upload } from "./api.js";
import { announce, byId, choose, chosen } from "./dom.js";
import { draw, Layers, readPreview } from "./light.js";
import { maskCodes } from "./marks.js";
import { markWithLittleEffect } from "./stroke_effect.js";
import { TileSet } from "./tiles.js";

const HOLD_MS = 300; // a longer press shows the photo only while it lasts
const NOTE_MS = 6000;

export class Viewer {
  #shown = null; // {photo, preview, layers, marks, mask: {list, codes}}
  #isPaintScheduled = false;
  #modeAfterMarks = null; // the mode that is chosen again when no marks are drawn any more
  #pressedAt = null; // when the button "Before" or its key was pressed
  #noteTimer = null;

  // `onChange()` is called when the pictures of a photo are ready.
  constructor(compare, tools, queue, { onChange }) {
    Object.assign(this, { compare, tools, queue, onChange });
    this.#watchBefore();
  }

  // Whether the pictures of a photo are shown.
  get isShowing() {
    return this.#shown !== null;
  }

  // Shows no photo.
  close() {
    this.#shown = null;
    this.compare.tiles?.close();
    this.compare.tiles = null;
    this.setBefore(false);
    this.hideStrokeNote();
    this.tools.show(null);
  }

  // Shows the current photo if it is separated.
  async show() {
    const { queue, compare, tools } = this;
    const photo = queue.current;
    if (photo?.state !== "done") return;
    const preview = await readPreview(photo.preview);
    // another photo was selected in the meantime
    if (photo !== queue.current || photo.state !== "done") return;
    const isUpdate = this.#shown?.photo === photo;
    const previous = this.#shown;
    if (isUpdate) compare.tiles?.close();
    else this.close();
    const layers = Layers.ofPreview(preview);
    const marks = photo.edits.list;
    this.#shown = { photo, preview, layers, marks, mask: { list: null, codes: null } };
    draw(compare.left, layers, "photo");
    compare.fullSize = preview.full;
    if (preview.full[0] > preview.width) compare.tiles = this.#tilesOf(photo, preview);
    tools.offerHints(queue.takesHints(photo));
    if (!isUpdate) tools.show(photo.edits, preview.full); // a mark that is being drawn goes on
    this.onChange();
    this.paint();
    tools.editor.fadeHints();
    if (isUpdate) this.#describeEffect(previous);
  }

  // Says at a mark as reflection if it has changed little.
  #describeEffect(previous) {
    const { layers, marks } = this.#shown;
    const added = marks.filter((mark) => !previous.marks.includes(mark));
    const mark = markWithLittleEffect(added, previous.layers, layers);
    if (mark === null) return;
    const note = byId("stroke-note");
    const { x, y } = this.compare.toView(mark.points.at(-1));
    Object.assign(note.style, { left: `${x}px`, top: `${y}px` });
    note.hidden = false;
    announce(note.textContent);
    this.#noteTimer = setTimeout(() => this.hideStrokeNote(), NOTE_MS);
  }

  hideStrokeNote() {
    clearTimeout(this.#noteTimer);
    byId("stroke-note").hidden = true;
  }

  // Shows the result instead of the line while marks are drawn, because the photo would cover half
  // of what they change.
  setMarking(isMarking) {
    this.hideStrokeNote();
    if (isMarking && chosen("mode") === "slider") {
      this.#setMode("result");
      this.#modeAfterMarks = "slider";
    } else if (!isMarking && this.#modeAfterMarks !== null) {
      this.#setMode(this.#modeAfterMarks);
    }
  }

  #setMode(mode) {
    choose("mode", mode);
    this.chooseMode();
  }

  // Shows the mode that the user has chosen.
  chooseMode() {
    this.#modeAfterMarks = null;
    this.compare.mode = chosen("mode");
  }

  // Draws the chosen layer before the next frame.
  paint() {
    if (!this.#shown || this.#isPaintScheduled) return;
    this.#isPaintScheduled = true;
    requestAnimationFrame(() => {
      this.#isPaintScheduled = false;
      if (this.#shown) this.#paintNow();
    });
  }

  #paintNow() {
    const { compare, queue } = this;
    const { edits, file } = queue.current;
    const layer = chosen("view");
    draw(compare.right, this.#shown.layers, layer, edits.strength, this.#mask());
    compare.version = `${layer} ${JSON.stringify(edits.now)}`;
    compare.show(file.name, layer);
  }

  // Returns the mask of the marks at the size of the reduced photo.
  #mask() {
    const shown = this.#shown;
    const { list } = this.queue.current.edits;
    const { width, height } = shown.preview;
    if (shown.mask.list !== list) shown.mask = { list, codes: maskCodes(list, width, height) };
    return shown.mask.codes;
  }

  // Returns the tiles of a photo.
  #tilesOf(photo, preview) {
    const context = { signal: new AbortController().signal, onProgress() {} };
    return new TileSet(preview, photo.upload, {
      resend: () => upload(photo, context),
      drawPhoto: (canvas, layers) => draw(canvas, layers, "photo"),
      drawRight(canvas, layers, part) {
        const { list, strength } = photo.edits;
        const [width, height] = preview.full.map((side) => side / 2 ** part.level);
        draw(canvas, layers, chosen("view"), strength, maskCodes(list, width, height, part));
      },
      onChange: () => this.compare.paint(),
    });
  }

  // Draws both layers on the buttons of the question which of them is behind the glass.
  drawNaming() {
    const { preview, layers } = this.#shown;
    byId("naming").classList.toggle("wide", preview.width > preview.height);
    for (const layer of ["transmission", "reflection"]) {
      draw(byId(`name-${layer}`).querySelector("canvas"), layers, layer, 1);
    }
  }

  // Shows the photo instead of the comparison, or the comparison again.
  setBefore(isBefore) {
    this.compare.isBefore = isBefore;
    byId("before").setAttribute("aria-pressed", isBefore);
  }

  // The button, the key B, or a finger on the result switch between photo and result; a longer
  // press shows the photo only while it lasts.
  #watchBefore() {
    const button = byId("before");
    button.addEventListener("pointerdown", () => this.#pressBefore());
    for (const kind of ["pointerup", "pointercancel", "pointerleave"]) {
      button.addEventListener(kind, () => this.#releaseBefore());
    }
    button.addEventListener("contextmenu", (event) => event.preventDefault()); // of a long touch
    button.addEventListener("click", ({ detail }) => {
      if (detail === 0) this.#pressBefore(); // not by a pointer
    });
    document.addEventListener("keydown", (event) => {
      if (isBeforeKey(event) && !event.repeat) this.#pressBefore();
    });
    document.addEventListener("keyup", (event) => {
      if (isBeforeKey(event)) this.#releaseBefore();
    });
    this.compare.addEventListener("hold", ({ detail }) => this.setBefore(detail));
  }

  #pressBefore() {
    if (!this.#shown) return;
    this.#pressedAt = performance.now();
    this.setBefore(!this.compare.isBefore);
  }

  #releaseBefore() {
    const isHeld = this.#pressedAt !== null && performance.now() - this.#pressedAt >= HOLD_MS;
    this.#pressedAt = null;
    if (isHeld) this.setBefore(false);
  }
}

function isBeforeKey({ key, ctrlKey, metaKey, altKey, target }) {
  const isWithModifier = ctrlKey || metaKey || altKey;
  return key.toLowerCase() === "b" && !isWithModifier && !target.closest("select");
}
