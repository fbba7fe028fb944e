// Tiles of the full photo, which are loaded when they are visible. Their layers are computed like
// those of the reduced photo.

import { Layers } from "./light.js";

const TILE_PX = 512;
const MAX_LEVEL = 8;
const MAX_TILES = 48; // maximum number of tiles in memory, about 10 MB each
const DRAW_MS = 40; // time for drawing tiles before the page reacts again

export class TileSet {
  #tiles = new Map(); // address -> tile; the most recently used tile is the last
  #isClosed = false;
  #isScheduled = false;
  #resent = null; // the promise of the last `resend()`

  // `preview`: the result of `readPreview`; `key`: the key of the photo on the server; `resend()`:
  // sends the photo again, once for all tiles, if the server has dropped it, and returns its key;
  // `drawPhoto(canvas, layers)`: draws the photo; `drawRight(canvas, layers, part)`: draws the
  // layer that is compared; `onChange()`: called when a tile has arrived.
  constructor(preview, key, { resend, drawPhoto, drawRight, onChange }) {
    Object.assign(this, { preview, key, resend, drawPhoto, drawRight, onChange });
  }

  close() {
    this.#isClosed = true;
    this.#tiles.clear();
  }

  // Returns the level with at least one pixel for each screen pixel. `scale` is the size of a photo
  // pixel in screen pixels.
  levelFor(scale) {
    return Math.min(MAX_LEVEL, Math.max(0, Math.floor(-Math.log2(scale) + 1e-6)));
  }

  // Returns the loaded tiles in an area of the photo, and requests the tiles that are not loaded.
  // `area` is {left, top, right, bottom} in pixels of the photo. The result is {tiles: [{canvas,
  // left, top, right, bottom}], missing}, where `missing` is the number of tiles that are not
  // loaded, or that could not be drawn with the current `version` within DRAW_MS.
  visible(side, level, area, version) {
    const step = TILE_PX << level;
    const [width, height] = this.preview.full;
    const started = performance.now();
    const tiles = [];
    let missing = 0;
    for (
      let row = Math.floor(Math.max(0, area.top) / step);
      row * step < Math.min(area.bottom, height);
      row++
    ) {
      for (
        let column = Math.floor(Math.max(0, area.left) / step);
        column * step < Math.min(area.right, width);
        column++
      ) {
        const tile = this.#tile(level, column, row);
        if (!tile.layers || !this.#draw(tile, side, version, started)) {
          missing++;
          continue;
        }
        const [left, top] = [column * step, row * step];
        tiles.push({
          canvas: tile[side],
          left,
          top,
          right: Math.min(width, left + step),
          bottom: Math.min(height, top + step),
        });
      }
    }
    return { tiles, missing };
  }

  #draw(tile, side, version, started) {
    const wanted = side === "left" ? "" : version;
    if (tile[`${side}Version`] === wanted) return true;
    if (performance.now() - started > DRAW_MS) {
      this.#drawLater();
      return false;
    }
    tile[side] ??= document.createElement("canvas");
    (side === "left" ? this.drawPhoto : this.drawRight)(tile[side], tile.layers, tile.part);
    tile[`${side}Version`] = wanted;
    return true;
  }

  #drawLater() {
    if (this.#isScheduled) return;
    this.#isScheduled = true;
    requestAnimationFrame(() => {
      this.#isScheduled = false;
      if (!this.#isClosed) this.onChange();
    });
  }

  #tile(level, column, row) {
    const address = `${level}/${column}/${row}`;
    const tile = this.#tiles.get(address) ?? { isLoading: true };
    if (!this.#tiles.has(address)) this.#load(tile, address, level, column, row);
    this.#tiles.delete(address);
    this.#tiles.set(address, tile);
    for (const [old, { isLoading }] of this.#tiles) {
      if (this.#tiles.size <= MAX_TILES) break;
      if (!isLoading) this.#tiles.delete(old);
    }
    return tile;
  }

  async #load(tile, address, level, column, row) {
    const resentBefore = this.#resent;
    try {
      let response = await fetch(`tile/${this.key}/${address}`);
      if (response.status === 404) {
        if (this.#resent === resentBefore) this.#resent = this.resend();
        this.key = await this.#resent;
        response = await fetch(`tile/${this.key}/${address}`);
      }
      if (!response.ok) throw new Error(`status ${response.status}`);
      const { codes, width, height } = await decode(await response.blob());
      const step = 1 << level;
      tile.part = {
        level,
        left: column * TILE_PX,
        top: row * TILE_PX,
        columns: width,
        rows: height,
      };
      const area = {
        left: tile.part.left * step,
        top: tile.part.top * step,
        stepX: step,
        stepY: step,
      };
      tile.layers = new Layers(this.preview, codes, width, height, area);
    } catch {
      setTimeout(() => {
        this.#tiles.delete(address);
        if (!this.#isClosed) this.onChange(); // the tile is requested again if it is still visible
      }, 3000);
    }
    tile.isLoading = false;
    if (!this.#isClosed) this.onChange();
  }
}

// Decodes a PNG file. Returns its 8-bit codes, three for each pixel, and its size.
async function decode(blob) {
  const bitmap = await createImageBitmap(blob, {
    colorSpaceConversion: "none",
    premultiplyAlpha: "none",
  });
  const { width, height } = bitmap;
  const canvas = Object.assign(document.createElement("canvas"), { width, height });
  const context = canvas.getContext("2d", { willReadFrequently: true });
  context.drawImage(bitmap, 0, 0);
  bitmap.close();
  const { data } = context.getImageData(0, 0, width, height);
  const codes = new Uint8Array(3 * width * height);
  for (let from = 0, to = 0; from < data.length; from += 4, to += 3) {
    codes[to] = data[from];
    codes[to + 1] = data[from + 1];
    codes[to + 2] = data[from + 2];
  }
  return { codes, width, height };
}
