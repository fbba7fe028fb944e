// <glass-compare>: shows a photo and one of its layers with the same zoom and pan, separated by a
// movable line, next to each other, or one at a time. Set `fullSize`, draw the reduced images on
// the canvases `left` and `right`, set `tiles` (a TileSet, or null), and call `show(...)`; call
// `paint()` after each change. `editor` draws marks: see editor.js. The event "painted" follows
// each change of what is shown.

const MAX_PIXEL_SIZE = 16; // maximum size of a photo pixel in screen pixels
const SHARP_PIXEL_SIZE = 2; // photo pixels of at least this size are drawn as squares
// in CSS pixels; a pointer that is closer to the line than this drags the line
const GRAB_DISTANCE_PX = 28;

class GlassCompare extends HTMLElement {
  left = document.createElement("canvas");
  right = document.createElement("canvas");
  fullSize = [1, 1]; // width and height of the photo
  tiles = null;
  editor = null;
  version = ""; // changes when the right image changes
  #mode = "slider";
  #isBefore = false;
  #split = 0.5; // position of the line as a fraction of the visible width of the image
  #pixelSize = null; // size of a photo pixel in screen pixels; null shows the whole image
  // the image point in the middle of the view, as fractions of width and height
  #centre = { x: 0.5, y: 0.5 };
  #missingTiles = 0; // visible parts that are shown reduced until their tiles arrive
  #pointers = new Map();
  #isHeld = false;
  #dragged = null; // what the pointer drags: "line", "image" or "mark"

  connectedCallback() {
    this.tabIndex = 0;
    this.setAttribute("role", "group");
    this.innerHTML = `<canvas aria-hidden="true"></canvas>
      <div class="line" role="slider" tabindex="0" aria-label="Line between photo and layer"
        aria-valuemin="0" aria-valuemax="100"></div>
      <span class="tag left" aria-hidden="true">Photo</span>
      <span class="tag right" aria-hidden="true"></span>`;
    this.canvas = this.querySelector("canvas");
    this.line = this.querySelector(".line");
    for (const kind of [
      "pointerdown",
      "pointermove",
      "pointerup",
      "pointercancel",
      "pointerleave",
      "wheel",
      "dblclick",
      "keydown",
    ]) {
      this.addEventListener(kind, (event) => this[`_${kind}`](event), { passive: false });
    }
    new ResizeObserver(() => this.paint()).observe(this);
  }

  // "slider", "side" (next to each other) or "result" (the right image only).
  set mode(mode) {
    this.#mode = mode;
    this.paint();
  }

  // Whether the photo is shown instead of the layer.
  get isBefore() {
    return this.#isBefore;
  }

  set isBefore(isBefore) {
    this.#isBefore = isBefore;
    this.paint();
  }

  // Sets the labels of both sides, visible and for screen readers.
  show(photo, layer) {
    this.setAttribute(
      "aria-label",
      `${photo}: the photo on the left, its ${layer} on the right. ` +
        "Plus and minus zoom, 0 shows all, 1 shows the pixels of the photo, " +
        "B switches between photo and result, arrow keys move the image.",
    );
    this.querySelector(".right").textContent = layer[0].toUpperCase() + layer.slice(1);
    this.paint();
  }

  // Shows the whole image, with the line in the middle.
  reset() {
    this.#split = 0.5;
    this.#pixelSize = null;
    this.#centre = { x: 0.5, y: 0.5 };
  }

  // Zooms by a factor around a point of a pane, by default the middle of the pane. A factor of 0
  // shows the whole image.
  zoomBy(factor, point = null) {
    const { width: viewWidth, height: viewHeight } = this.#panes()[0];
    const { x, y } = point ?? { x: viewWidth / 2, y: viewHeight / 2 };
    const before = this.#placement();
    const zoom = factor === 0 ? 1 : this.#limited(this.#zoom * factor);
    this.#pixelSize = zoom === 1 ? null : zoom / this.#fullZoom();
    const at = { x: (x - before.left) / before.width, y: (y - before.top) / before.height };
    const { width, height } = this.#placement();
    this.#centre = {
      x: at.x - (x - viewWidth / 2) / width,
      y: at.y - (y - viewHeight / 2) / height,
    };
    this.paint();
  }

  // Zooms around a point of a pane until one photo pixel is one screen pixel.
  zoomToFull(point = null) {
    this.zoomBy(this.#fullZoom() / this.#zoom, point);
    this.#pixelSize = 1;
    this.paint();
  }

  // The zoom: 1 shows the whole image. The size of a photo pixel on the screen stays the same if
  // the mode or the size of the view changes, so that 1:1 stays 1:1.
  get #zoom() {
    return this.#pixelSize === null ? 1 : this.#limited(this.#pixelSize * this.#fullZoom());
  }

  // A small photo is enlarged, so that 1:1 is smaller than the whole view.
  #limited(zoom) {
    const min = Math.min(1, this.#fullZoom());
    const max = Math.max(1, MAX_PIXEL_SIZE * this.#fullZoom());
    return Math.min(max, Math.max(min, zoom));
  }

  // Returns the zoom at which one photo pixel is one screen pixel.
  #fullZoom() {
    return this.fullSize[0] / this.#fit().width / this.#density;
  }

  // The size of a photo pixel in screen pixels.
  get pixelSize() {
    return this.#zoom / this.#fullZoom();
  }

  get #density() {
    return window.devicePixelRatio || 1;
  }

  // Returns the parts of the view that show an image: {side, x, y, width, height} in CSS pixels.
  // All have the same size.
  #panes() {
    const [width, height] = [this.clientWidth, this.clientHeight];
    if (this.#mode === "side") {
      const isWide = width >= height;
      const size = isWide ? { width: width / 2, height } : { width, height: height / 2 };
      return [
        { side: "left", x: 0, y: 0, ...size },
        { side: "right", x: isWide ? width / 2 : 0, y: isWide ? 0 : height / 2, ...size },
      ];
    }
    return [{ side: "right", x: 0, y: 0, width, height }];
  }

  // Returns the size of the whole image in a pane, in CSS pixels. Small images are enlarged by a
  // factor of at most 2.
  #fit() {
    const [{ width: viewWidth, height: viewHeight }] = this.#panes();
    // not the size of the reduced image, because its aspect ratio is rounded
    const [width, height] = this.fullSize;
    const scale = Math.min(viewWidth / width, viewHeight / height, 2);
    return { width: width * scale, height: height * scale };
  }

  // Returns the position and size of the image in a pane, in CSS pixels. Limits the pan, so that a
  // zoomed image covers the pane.
  #placement() {
    const [{ width: viewWidth, height: viewHeight }] = this.#panes();
    const fit = this.#fit();
    const [width, height] = [fit.width * this.#zoom, fit.height * this.#zoom];
    const start = (view, length, centre) =>
      length <= view
        ? (view - length) / 2
        : Math.min(0, Math.max(view - length, view / 2 - centre * length));
    const left = start(viewWidth, width, this.#centre.x);
    const top = start(viewHeight, height, this.#centre.y);
    this.#centre = { x: (viewWidth / 2 - left) / width, y: (viewHeight / 2 - top) / height };
    return { left, top, width, height };
  }

  // Returns the left and right ends of the visible part of the image, and the position of the line,
  // in CSS pixels.
  #visible(placement = this.#placement()) {
    const [from, to] = [
      Math.max(0, placement.left),
      Math.min(this.clientWidth, placement.left + placement.width),
    ];
    return { from, to, line: from + this.#split * (to - from) };
  }

  paint() {
    if (!this.canvas || !this.clientWidth || !this.clientHeight || !this.left.width) return;
    // Round to whole screen pixels, so that at 1:1 each photo pixel is exactly one screen pixel.
    const round = (length) => Math.round(length * this.#density) / this.#density;
    const { left, top, width, height } = this.#placement();
    const placement = { left: round(left), top: round(top), width, height };
    const { line } = this.#visible(placement);
    this.canvas.width = Math.round(this.clientWidth * this.#density);
    this.canvas.height = Math.round(this.clientHeight * this.#density);
    const context = this.canvas.getContext("2d");
    context.imageSmoothingEnabled = this.pixelSize < SHARP_PIXEL_SIZE;
    context.imageSmoothingQuality = "high";
    const isSlider = this.#mode === "slider" && !this.#isBefore;
    this.#missingTiles = 0;
    for (const pane of this.#panes()) {
      const side = this.#isBefore ? "left" : pane.side;
      if (isSlider) {
        this.#paintSide(context, "left", pane, placement, 0, line);
        this.#paintSide(context, "right", pane, placement, line, pane.width);
      } else this.#paintSide(context, side, pane, placement, 0, pane.width);
    }
    this.#describe(isSlider, line, placement);
  }

  // Draws one image in a pane, from `from` to `to` of its width: the reduced image, the tiles above
  // it, and the marks.
  #paintSide(context, side, pane, placement, from, to) {
    const density = this.#density;
    const [x0, x1] = [Math.round((pane.x + from) * density), Math.round((pane.x + to) * density)];
    context.save();
    context.beginPath();
    context.rect(x0, pane.y * density, x1 - x0, pane.height * density);
    context.clip();
    const origin = {
      x: (pane.x + placement.left) * density,
      y: (pane.y + placement.top) * density,
    };
    const size = { width: placement.width * density, height: placement.height * density };
    context.drawImage(this[side], origin.x, origin.y, size.width, size.height);
    const pixel = size.width / this.fullSize[0];
    if (this.tiles && pixel * this.fullSize[0] > this.left.width) {
      const area = {
        left: ((from - placement.left) * density) / pixel,
        right: ((to - placement.left) * density) / pixel,
        top: (-placement.top * density) / pixel,
        bottom: ((pane.height - placement.top) * density) / pixel,
      };
      const { tiles, missing } = this.tiles.visible(
        side,
        this.tiles.levelFor(pixel),
        area,
        this.version,
      );
      this.#missingTiles += missing;
      for (const tile of tiles) {
        const [left, top] = [
          Math.round(origin.x + tile.left * pixel),
          Math.round(origin.y + tile.top * pixel),
        ];
        const [right, bottom] = [
          Math.round(origin.x + tile.right * pixel),
          Math.round(origin.y + tile.bottom * pixel),
        ];
        context.drawImage(tile.canvas, left, top, right - left, bottom - top);
      }
    }
    this.editor?.paint(context, origin, size);
    context.restore();
  }

  #describe(isSlider, line, { top, height }) {
    const isSide = this.#mode === "side";
    this.line.hidden = !isSlider;
    this.line.style.left = `${line}px`;
    this.line.style.top = `${Math.max(0, top)}px`;
    this.line.style.bottom = `${Math.max(0, this.clientHeight - top - height)}px`;
    this.line.setAttribute("aria-valuenow", Math.round(100 * this.#split));
    this.line.setAttribute("aria-valuetext", `${Math.round(100 * this.#split)} % photo`);
    const [first, second] = [this.querySelector(".tag.left"), this.querySelector(".tag.right")];
    const isEditing = Boolean(this.editor?.isActive); // the labels would cover what is marked
    first.hidden = isEditing || !(isSlider || isSide || this.#isBefore);
    second.hidden = isEditing || this.#isBefore;
    second.style.top = isSide && this.clientWidth < this.clientHeight ? `calc(50% + 0.75rem)` : "";
    this.setAttribute("aria-busy", this.#missingTiles > 0);
    this.classList.toggle("zoomed", this.#zoom > 1);
    this.classList.toggle("editing", isEditing);
    this.dispatchEvent(new Event("painted"));
  }

  #moveLine(x) {
    const { from, to } = this.#visible();
    this.#split = Math.min(1, Math.max(0, (x - from) / (to - from)));
    this.paint();
  }

  #pan(right, down) {
    const { width, height } = this.#placement();
    this.#centre = { x: this.#centre.x - right / width, y: this.#centre.y - down / height };
    this.paint();
  }

  // Returns the position of a pointer in the view.
  #point(event) {
    const box = this.getBoundingClientRect();
    return { x: event.clientX - box.left, y: event.clientY - box.top };
  }

  // Converts a position in the view to a position in the pane that contains it.
  #inPane({ x, y }) {
    const panes = this.#panes();
    const pane = panes.findLast((one) => x >= one.x && y >= one.y) ?? panes[0];
    return { x: x - pane.x, y: y - pane.y };
  }

  // Converts a position in the view to a position in the photo, in fractions of the longer side of
  // the photo.
  #inPhoto(point) {
    const placement = this.#placement();
    const { x, y } = this.#inPane(point);
    const longer = Math.max(placement.width, placement.height);
    return [(x - placement.left) / longer, (y - placement.top) / longer];
  }

  // Converts a position in the photo, in fractions of its longer side, to one in the view.
  toView([x, y]) {
    const pane = this.#panes().at(-1);
    const { left, top, width, height } = this.#placement();
    const longer = Math.max(width, height);
    return { x: pane.x + left + x * longer, y: pane.y + top + y * longer };
  }

  // Returns what a pointer drags after it is pressed at a point. While marks are drawn, only the
  // handle of the line drags the line.
  #draggedAt(point, target) {
    const hasLine = this.#mode === "slider" && !this.#isBefore;
    const isNear = hasLine && Math.abs(point.x - this.#visible().line) < GRAB_DISTANCE_PX;
    if (this.editor?.isActive) {
      return target === this.line && Math.abs(point.y - this.clientHeight / 2) < GRAB_DISTANCE_PX
        ? "line"
        : "mark";
    }
    return hasLine && (this.#zoom <= 1 || isNear) ? "line" : "image";
  }

  _pointerdown(event) {
    if (event.button) return;
    const point = this.#point(event);
    this.setPointerCapture(event.pointerId);
    this.#pointers.set(event.pointerId, point);
    if (this.#pointers.size > 1) {
      this.#hold(false);
      return this.editor?.cancel(); // two fingers zoom
    }
    this.#dragged = this.#draggedAt(point, event.target);
    if (this.#dragged === "image" && this.#mode === "result" && this.#zoom <= 1) this.#hold(true);
    if (this.#dragged === "mark") this.editor.start(this.#inPhoto(point));
    else if (this.#dragged === "line" && event.pointerType === "mouse") this.#moveLine(point.x);
  }

  _pointermove(event) {
    const before = this.#pointers.get(event.pointerId);
    const now = this.#point(event);
    if (!before) {
      if (this.editor?.isActive) this.editor.hover(this.#inPhoto(now));
      return;
    }
    this.#pointers.set(event.pointerId, now);
    if (this.#pointers.size === 2) this.#pinch(event.pointerId, before, now);
    else if (this.#dragged === "mark") this.editor.move(this.#inPhoto(now));
    else if (this.#dragged === "line") this.#moveLine(now.x);
    else this.#pan(now.x - before.x, now.y - before.y);
  }

  #pinch(id, before, now) {
    const [other] = [...this.#pointers].filter(([key]) => key !== id).map(([, point]) => point);
    const distance = (point) => Math.hypot(point.x - other.x, point.y - other.y) || 1;
    this.zoomBy(
      distance(now) / distance(before),
      this.#inPane({ x: (now.x + other.x) / 2, y: (now.y + other.y) / 2 }),
    );
    this.#pan((now.x - before.x) / 2, (now.y - before.y) / 2);
    this.#dragged = "image";
  }

  // The result is held: the event "hold" asks to show the photo while this lasts.
  #hold(isHeld) {
    if (this.#isHeld === isHeld) return;
    this.#isHeld = isHeld;
    this.dispatchEvent(new CustomEvent("hold", { detail: isHeld }));
  }

  _pointerup(event) {
    this.#hold(false);
    if (this.#pointers.delete(event.pointerId) && this.#dragged === "mark") this.editor.end();
  }

  _pointercancel(event) {
    this.#hold(false);
    if (this.#pointers.delete(event.pointerId) && this.#dragged === "mark") this.editor.cancel();
  }

  _pointerleave(event) {
    if (this.editor?.isActive && !this.#pointers.size)
      this.editor.hover(null, event.pointerType !== "mouse");
  }

  _wheel(event) {
    event.preventDefault();
    this.zoomBy(1.0015 ** -event.deltaY, this.#inPane(this.#point(event)));
  }

  _dblclick(event) {
    if (this.editor?.isActive) return;
    const point = this.#inPane(this.#point(event));
    if (this.#zoom > 1) this.zoomBy(0);
    else if (this.#fullZoom() > 1) this.zoomToFull(point);
    else this.zoomBy(3, point);
  }

  _keydown(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const { from, to, line } = this.#visible();
    const step = (to - from) / 100;
    const onLine = {
      ArrowLeft: line - step,
      ArrowDown: line - step,
      ArrowRight: line + step,
      ArrowUp: line + step,
      PageDown: line - 10 * step,
      PageUp: line + 10 * step,
      Home: from,
      End: to,
    };
    const onImage = {
      ArrowLeft: [60, 0],
      ArrowRight: [-60, 0],
      ArrowUp: [0, 60],
      ArrowDown: [0, -60],
    };
    const zooms = { "+": 1.5, "=": 1.5, "-": 1 / 1.5, 0: 0 };
    if (event.key in zooms) this.zoomBy(zooms[event.key]);
    else if (event.key === "1") this.zoomToFull();
    else if (event.target === this.line && event.key in onLine) this.#moveLine(onLine[event.key]);
    else if (event.target === this && this.editor?.isActive && this.editor.press(event))
      this.paint();
    else if (event.target === this && event.key in onImage) this.#pan(...onImage[event.key]);
    else return;
    event.preventDefault();
  }
}

customElements.define("glass-compare", GlassCompare);
