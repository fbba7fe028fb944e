// The pictures of the current photo: the comparison with its tiles, the marks, and the question
// which of two measured layers is behind the glass.

import { byId, chosen } from "./dom.js";
import { send } from "./api.js";
import { draw, Layers, readPreview } from "./light.js";
import { maskCodes } from "./marks.js";
import { TileSet } from "./tiles.js";

export class Viewer {
  #shown = null; // {photo, preview, layers, mask: {list, codes}}
  #isPaintScheduled = false;

  // `onChange()` is called when the pictures of a photo are ready.
  constructor(compare, tools, queue, { onChange }) {
    Object.assign(this, { compare, tools, queue, onChange });
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
    if (isUpdate) compare.tiles?.close();
    else this.close();
    const layers = Layers.ofPreview(preview);
    this.#shown = { photo, preview, layers, mask: { list: null, codes: null } };
    draw(compare.left, layers, "photo");
    compare.fullSize = preview.full;
    if (preview.full[0] > preview.width) compare.tiles = this.#tilesOf(photo, preview);
    tools.offerHints(queue.takesHints(photo));
    if (!isUpdate) tools.show(photo.edits, preview.full); // a mark that is being drawn goes on
    this.onChange();
    this.paint();
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
    return new TileSet(preview, photo.key, {
      resend: () => send("photo", photo.file, {}, context),
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

  toggleBefore() {
    if (this.#shown) this.setBefore(!this.compare.isBefore);
  }
}
