// Synchronised pan and zoom for several frames that show pictures of the same size. A frame has the
// aspect ratio of its picture. Offsets are fractions of the frame size, so that all frames show the
// same part.

const MAX_PIXEL_SIZE = 8; // maximum size of a picture pixel in screen pixels
const ZOOM_STEP = 1.5; // factor
const PAN_STEP = 0.12; // fraction of the frame size

export class PanZoom {
  #scale = 1;
  #x = 0; // offsets of the left and upper edge, as fractions of the frame size: 0 or less
  #y = 0;
  #size = [1, 1];
  // whether one picture pixel stays one screen pixel if the pictures or the frame size change
  #full = false;
  #pointers = new Map();

  constructor(box, frames) {
    this.box = box;
    this.frames = frames;
    for (const frame of frames) {
      frame.addEventListener("wheel", (event) => this.#wheel(event, frame), { passive: false });
      frame.addEventListener("dblclick", (event) => this.#toggle(...this.#point(event, frame)));
      frame.addEventListener("pointerdown", (event) => this.#down(event, frame));
      frame.addEventListener("pointermove", (event) => this.#move(event, frame));
      for (const end of ["pointerup", "pointercancel"]) {
        frame.addEventListener(end, (event) => this.#pointers.delete(event.pointerId));
      }
    }
    new ResizeObserver(() => this.#resized()).observe(box);
  }

  // Shows new pictures of this size in px. They are shown at full size if the earlier pictures
  // were, and otherwise without zoom.
  reset(width, height) {
    this.#size = [width, height];
    this.#scale = 1;
    if (this.#full) this.zoom("full", true);
    else this.zoom("fit");
  }

  // Zooms by the name of a button: in, out, fit or full.
  zoom(kind, keep = false) {
    const full = kind === "full" && (keep || !this.#full);
    if (kind === "in") this.#zoomTo(this.#scale * ZOOM_STEP);
    else if (kind === "out") this.#zoomTo(this.#scale / ZOOM_STEP);
    else this.#zoomTo(full ? this.#fullScale() : 1);
    this.#full = full;
    this.#paint();
  }

  // Whether one picture pixel is one screen pixel.
  get isFull() {
    return this.#full;
  }

  // Whether the pictures are larger than their frames.
  get isZoomed() {
    return this.#scale > 1;
  }

  #resized() {
    if (this.#full) this.zoom("full", true);
    else this.#paint();
  }

  // Handles a key. Returns true if the key zooms or pans.
  press(key) {
    const zooms = { "+": "in", "=": "in", "-": "out", _: "out", 0: "fit", f: "full", F: "full" };
    const pans = {
      "Shift+ArrowLeft": [PAN_STEP, 0],
      "Shift+ArrowRight": [-PAN_STEP, 0],
      "Shift+ArrowUp": [0, PAN_STEP],
      "Shift+ArrowDown": [0, -PAN_STEP],
    };
    if (key in zooms) this.zoom(zooms[key]);
    else if (key in pans) this.#pan(...pans[key]);
    else return false;
    return true;
  }

  // Returns the scale at which one picture pixel is one screen pixel in the largest frame.
  #fullScale() {
    const fits = this.frames.map(({ clientWidth, clientHeight }) =>
      Math.min(clientWidth / this.#size[0], clientHeight / this.#size[1]),
    );
    return Math.max(1, 1 / (Math.max(...fits, 1e-6) * devicePixelRatio));
  }

  #zoomTo(scale, x = 0.5, y = 0.5) {
    const next = Math.min(Math.max(1, scale), MAX_PIXEL_SIZE * this.#fullScale());
    this.#x = x - ((x - this.#x) * next) / this.#scale;
    this.#y = y - ((y - this.#y) * next) / this.#scale;
    this.#scale = next;
    this.#full = false;
    this.#paint();
  }

  #pan(right, down) {
    this.#x += right;
    this.#y += down;
    this.#paint();
  }

  #paint() {
    const clamp = (at) => Math.min(0, Math.max(1 - this.#scale, at));
    [this.#x, this.#y] = [clamp(this.#x), clamp(this.#y)];
    for (const frame of this.frames)
      Object.assign(frame.firstElementChild.style, this.#style(frame));
    this.box.classList.toggle("zoomed", this.#scale > 1);
    this.box.classList.toggle("pixelated", this.#scale > 3 * this.#fullScale());
    this.box.dispatchEvent(new Event("zoomed"));
  }

  // Returns the size and position of a picture. At full size they are whole screen pixels without a
  // scale, because the browser would resample a scaled picture, and so blur its pixels.
  #style({ clientWidth, clientHeight }) {
    if (!this.#full || this.#scale === 1) {
      return {
        width: "",
        height: "",
        transform: `translate(${100 * this.#x}%, ${100 * this.#y}%) scale(${this.#scale})`,
      };
    }
    const [width, height] = this.#size.map((side) => `${side / devicePixelRatio}px`);
    const [left, top] = [this.#x * clientWidth, this.#y * clientHeight].map(
      (at) => Math.round(at * devicePixelRatio) / devicePixelRatio,
    );
    return { width, height, transform: `translate(${left}px, ${top}px)` };
  }

  #point(event, frame) {
    const box = frame.getBoundingClientRect();
    return [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
  }

  #toggle(x, y) {
    this.#zoomTo(this.#scale > 1 ? 1 : Math.max(2, this.#fullScale()), x, y);
  }

  #wheel(event, frame) {
    event.preventDefault();
    this.#zoomTo(this.#scale * 1.002 ** -event.deltaY, ...this.#point(event, frame));
  }

  #down(event, frame) {
    if (event.button) return;
    frame.setPointerCapture(event.pointerId);
    this.#pointers.set(event.pointerId, this.#point(event, frame));
  }

  #move(event, frame) {
    const before = this.#pointers.get(event.pointerId);
    if (!before) return;
    const now = this.#point(event, frame);
    this.#pointers.set(event.pointerId, now);
    const others = [...this.#pointers]
      .filter(([id]) => id !== event.pointerId)
      .map(([, point]) => point);
    if (others.length === 1) this.#pinch(before, now, others[0]);
    else if (this.#scale > 1) this.#pan(now[0] - before[0], now[1] - before[1]);
  }

  #pinch(before, now, other) {
    const distance = ([x, y]) => Math.hypot(x - other[0], y - other[1]) || 1;
    this.#zoomTo(
      (this.#scale * distance(now)) / distance(before),
      (now[0] + other[0]) / 2,
      (now[1] + other[1]) / 2,
    );
    this.#pan((now[0] - before[0]) / 2, (now[1] - before[1]) / 2);
  }
}
