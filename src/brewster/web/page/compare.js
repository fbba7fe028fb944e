// <glass-compare>: compares two images of the same size, separated by a movable line. Zoom and pan apply to both.
// Draw on the canvases `left` and `right`, call `show(...)`, and call `paint()` after each change.

const MAX_PIXEL_SIZE = 8; // maximum size of an image pixel in screen pixels
const GRAB_DISTANCE = 28; // in CSS pixels: in a zoomed image, a pointer at most this far from the line drags the line

class GlassCompare extends HTMLElement {
  left = document.createElement("canvas");
  right = document.createElement("canvas");
  #split = 0.5; // position of the line as a fraction of the visible width of the image
  #zoom = 1; // 1 shows the whole image
  #centre = { x: 0.5, y: 0.5 }; // the image point in the middle of the view, as fractions of width and height
  #pointers = new Map();
  #dragged = null; // what the pointer drags: "line" or "image"

  connectedCallback() {
    this.tabIndex = 0;
    this.setAttribute("role", "group");
    this.innerHTML = `<canvas aria-hidden="true"></canvas>
      <div class="line" role="slider" tabindex="0" aria-label="Line between the two"
        aria-valuemin="0" aria-valuemax="100"></div>
      <span class="tag left" aria-hidden="true">Photo</span><span class="tag right" aria-hidden="true"></span>
      <div class="zoom" role="group" aria-label="Zoom">
        <button type="button" data-by="0.5" aria-label="Zoom out">−</button>
        <button type="button" data-by="0" aria-label="Show all">Fit</button>
        <button type="button" data-by="2" aria-label="Zoom in">+</button></div>`;
    this.canvas = this.querySelector("canvas");
    this.line = this.querySelector(".line");
    for (const kind of ["pointerdown", "pointermove", "pointerup", "pointercancel", "wheel", "dblclick", "keydown"]) {
      this.addEventListener(kind, (event) => this[`_${kind}`](event), { passive: false });
    }
    for (const button of this.querySelectorAll("button")) {
      button.addEventListener("click", () => this.zoomBy(Number(button.dataset.by)));
    }
    new ResizeObserver(() => this.paint()).observe(this);
  }

  // Sets the labels of both sides, visible and for screen readers.
  show(photo, layer) {
    this.setAttribute("aria-label", `${photo}: the photo on the left, its ${layer} on the right. `
      + "Plus and minus zoom, 0 shows all, arrow keys move the picture.");
    this.querySelector(".right").textContent = layer[0].toUpperCase() + layer.slice(1);
    this.paint();
  }

  // Shows the whole image, with the line in the middle.
  reset() {
    [this.#split, this.#zoom, this.#centre] = [0.5, 1, { x: 0.5, y: 0.5 }];
  }

  // Zooms by a factor around a point of the view, by default its middle. A factor of 0 shows the whole image.
  zoomBy(factor, x = this.clientWidth / 2, y = this.clientHeight / 2) {
    const before = this.#placement();
    const maxZoom = Math.max(1, (MAX_PIXEL_SIZE * this.left.width) / this.#fit().width / (window.devicePixelRatio || 1));
    this.#zoom = factor === 0 ? 1 : Math.min(maxZoom, Math.max(1, this.#zoom * factor));
    const at = { x: (x - before.left) / before.width, y: (y - before.top) / before.height };
    const { width, height } = this.#placement();
    this.#centre = { x: at.x - (x - this.clientWidth / 2) / width, y: at.y - (y - this.clientHeight / 2) / height };
    this.paint();
  }

  // The size of the whole image in the view, in CSS pixels. Small images are enlarged by a factor of at most 2.
  #fit() {
    const { width, height } = this.left;
    const scale = Math.min(this.clientWidth / width, this.clientHeight / height, 2);
    return { width: width * scale, height: height * scale };
  }

  // The position and size of the image in the view, in CSS pixels. Limits the pan, so that the image covers the view.
  #placement() {
    const fit = this.#fit();
    const [width, height] = [fit.width * this.#zoom, fit.height * this.#zoom];
    const start = (view, length, centre) =>
      length <= view ? (view - length) / 2 : Math.min(0, Math.max(view - length, view / 2 - centre * length));
    const left = start(this.clientWidth, width, this.#centre.x);
    const top = start(this.clientHeight, height, this.#centre.y);
    this.#centre = { x: (this.clientWidth / 2 - left) / width, y: (this.clientHeight / 2 - top) / height };
    return { left, top, width, height };
  }

  // The left and right ends of the visible part of the image, and the position of the line, in CSS pixels.
  #visible(placement = this.#placement()) {
    const [from, to] = [Math.max(0, placement.left), Math.min(this.clientWidth, placement.left + placement.width)];
    return { from, to, line: from + this.#split * (to - from) };
  }

  paint() {
    if (!this.canvas || !this.clientWidth || !this.clientHeight) return;
    const density = window.devicePixelRatio || 1;
    const placement = this.#placement();
    const { line } = this.#visible(placement);
    this.canvas.width = Math.round(this.clientWidth * density);
    this.canvas.height = Math.round(this.clientHeight * density);
    const context = this.canvas.getContext("2d");
    context.scale(density, density);
    context.imageSmoothingEnabled = placement.width < 4 * this.left.width;
    context.imageSmoothingQuality = "high";
    for (const [side, start, end] of [[this.left, 0, line], [this.right, line, this.clientWidth]]) {
      context.save();
      context.beginPath();
      context.rect(start, 0, end - start, this.clientHeight);
      context.clip();
      if (side.width) context.drawImage(side, placement.left, placement.top, placement.width, placement.height);
      context.restore();
    }
    this.line.style.left = `${line}px`;
    this.line.setAttribute("aria-valuenow", Math.round(100 * this.#split));
    this.line.setAttribute("aria-valuetext", `${Math.round(100 * this.#split)} % photo`);
    this.classList.toggle("zoomed", this.#zoom > 1);
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

  #point(event) {
    const box = this.getBoundingClientRect();
    return { x: event.clientX - box.left, y: event.clientY - box.top };
  }

  _pointerdown(event) {
    if (event.button || event.target.closest(".zoom")) return;
    const point = this.#point(event);
    this.setPointerCapture(event.pointerId);
    this.#pointers.set(event.pointerId, point);
    const isNear = Math.abs(point.x - this.#visible().line) < GRAB_DISTANCE;
    this.#dragged = this.#zoom === 1 || isNear ? "line" : "image";
    if (this.#dragged === "line" && this.#pointers.size === 1 && event.pointerType === "mouse") this.#moveLine(point.x);
  }

  _pointermove(event) {
    const before = this.#pointers.get(event.pointerId);
    if (!before) return;
    const now = this.#point(event);
    this.#pointers.set(event.pointerId, now);
    if (this.#pointers.size === 2) this.#pinch(event.pointerId, before, now);
    else if (this.#dragged === "line") this.#moveLine(now.x);
    else this.#pan(now.x - before.x, now.y - before.y);
  }

  #pinch(id, before, now) {
    const [other] = [...this.#pointers].filter(([key]) => key !== id).map(([, point]) => point);
    const distance = (point) => Math.hypot(point.x - other.x, point.y - other.y) || 1;
    this.zoomBy(distance(now) / distance(before), (now.x + other.x) / 2, (now.y + other.y) / 2);
    this.#pan((now.x - before.x) / 2, (now.y - before.y) / 2);
    this.#dragged = "image";
  }

  _pointerup(event) {
    this.#pointers.delete(event.pointerId);
  }

  _pointercancel(event) {
    this.#pointers.delete(event.pointerId);
  }

  _wheel(event) {
    event.preventDefault();
    const point = this.#point(event);
    this.zoomBy(1.0015 ** -event.deltaY, point.x, point.y);
  }

  _dblclick(event) {
    if (event.target.closest(".zoom")) return;
    const point = this.#point(event);
    this.zoomBy(this.#zoom > 1 ? 0 : 3, point.x, point.y);
  }

  _keydown(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const { from, to, line } = this.#visible();
    const step = (to - from) / 100;
    const onLine = { ArrowLeft: line - step, ArrowDown: line - step, ArrowRight: line + step, ArrowUp: line + step,
      PageDown: line - 10 * step, PageUp: line + 10 * step, Home: from, End: to };
    const onImage = { ArrowLeft: [60, 0], ArrowRight: [-60, 0], ArrowUp: [0, 60], ArrowDown: [0, -60] };
    const zooms = { "+": 1.5, "=": 1.5, "-": 1 / 1.5, 0: 0 };
    if (event.key in zooms) this.zoomBy(zooms[event.key]);
    else if (event.target === this.line && event.key in onLine) this.#moveLine(onLine[event.key]);
    else if (event.target === this && event.key in onImage) this.#pan(...onImage[event.key]);
    else return;
    event.preventDefault();
  }
}

customElements.define("glass-compare", GlassCompare);
