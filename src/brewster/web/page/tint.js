// The tint over marks on the picture: dark over the protected areas, with a white outline, and red
// and green over hints. The tint of hints fades when the result that they led to is shown, so that
// the result can be seen.

import { hintCodes, maskCodes } from "./marks.js";

const OPACITY = 0.3;
const MAX_PX = 800; // longer side of the images of the tint
const FADE_MS = 400;
const REFLECTION_COLOUR = [255, 0, 60];
const SCENE_COLOUR = [0, 200, 60];

export class Tint {
  #protection = document.createElement("canvas");
  #hints = document.createElement("canvas");
  #key = null; // the marks and the size of the images, as text
  #fadeStart = -Infinity; // when the tint of the hints began to fade; null while it is visible

  // The opacity of the tint of the hints, 0 to 1.
  get #hintOpacity() {
    if (this.#fadeStart === null) return 1;
    const isReduced = matchMedia("(prefers-reduced-motion: reduce)").matches;
    const elapsed = performance.now() - this.#fadeStart;
    return isReduced ? 0 : Math.max(0, 1 - elapsed / FADE_MS);
  }

  showHints() {
    this.#fadeStart = null;
  }

  // `onChange()` is called before each frame of the fading.
  fadeHints(onChange) {
    if (this.#fadeStart !== null) return;
    this.#fadeStart = performance.now();
    const step = () => {
      onChange();
      if (this.#hintOpacity > 0 && this.#fadeStart !== null) requestAnimationFrame(step);
    };
    step();
  }

  // Draws the tint of marks above a picture at `origin` with `size`, in screen pixels. The photo
  // has `photoSize` pixels.
  paint(context, list, photoSize, origin, size, areHintsShown) {
    this.#update(list, photoSize);
    const place = [origin.x, origin.y, size.width, size.height];
    context.drawImage(this.#protection, ...place);
    context.save();
    context.globalAlpha = areHintsShown ? 1 : this.#hintOpacity;
    context.drawImage(this.#hints, ...place);
    context.restore();
  }

  #update(list, photoSize) {
    const scale = Math.min(1, MAX_PX / Math.max(...photoSize));
    const [width, height] = photoSize.map((side) => Math.max(1, Math.round(side * scale)));
    const key = JSON.stringify([list, width, height]);
    if (key === this.#key) return;
    this.#key = key;
    for (const [canvas, pixels] of [
      [this.#protection, protectionPixels(list, width, height)],
      [this.#hints, hintPixels(list, width, height)],
    ]) {
      Object.assign(canvas, { width, height });
      canvas.getContext("2d").putImageData(new ImageData(pixels, width, height), 0, 0);
    }
  }
}

// Returns the tint of the protected areas: black, with a white outline (RGBA).
function protectionPixels(list, width, height) {
  const pixels = new Uint8ClampedArray(4 * width * height);
  const mask = maskCodes(list, width, height);
  if (mask === null) return pixels;
  const isProtected = (i) => mask[i] <= 127;
  for (let i = 0; i < mask.length; i++) {
    pixels[4 * i + 3] = OPACITY * (255 - mask[i]);
    const isEdgeAcross = i % width > 0 && isProtected(i) !== isProtected(i - 1);
    const isEdgeDown = i >= width && isProtected(i) !== isProtected(i - width);
    if (isEdgeAcross || isEdgeDown) pixels.fill(255, 4 * i, 4 * i + 4);
  }
  return pixels;
}

// Returns the tint of the hints: red over the reflection, and green over the scene (RGBA).
function hintPixels(list, width, height) {
  const pixels = new Uint8ClampedArray(4 * width * height);
  const reflection = hintCodes(list, "reflection", width, height);
  const scene = hintCodes(list, "scene", width, height);
  for (let i = 0; i < reflection.length; i++) {
    const isReflection = reflection[i] >= scene[i];
    pixels.set(isReflection ? REFLECTION_COLOUR : SCENE_COLOUR, 4 * i);
    pixels[4 * i + 3] = OPACITY * Math.max(reflection[i], scene[i]);
  }
  return pixels;
}
