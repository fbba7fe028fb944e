// Whether a mark as reflection has changed what it covers.

import { draw } from "./light.js";
import { hintCodes } from "./marks.js";

const VISIBLE_CODES = 3; // mean change of 8-bit codes that can be seen in a still picture

// Returns the first of `marks` that changed little between two results (Layers), or null.
export function markWithLittleEffect(marks, before, after) {
  const strokes = marks.filter(({ kind }) => kind === "reflection");
  if (!strokes.length) return null;
  const codes = [before, after].map(transmissionCodes);
  const { width, height } = after;
  const change = (mark) => meanChange(hintCodes([mark], "reflection", width, height), ...codes);
  return strokes.find((mark) => change(mark) < VISIBLE_CODES) ?? null;
}

function transmissionCodes(layers) {
  const canvas = document.createElement("canvas");
  draw(canvas, layers, "transmission", 1);
  const { width, height } = canvas;
  return canvas.getContext("2d").getImageData(0, 0, width, height).data;
}

// Returns the mean absolute difference of two images (RGBA) where `weights`, one for each pixel,
// are large.
function meanChange(weights, before, after) {
  let sum = 0;
  let total = 0;
  for (let i = 0; i < weights.length; i++) {
    if (!weights[i]) continue;
    for (let at = 4 * i; at < 4 * i + 3; at++) sum += weights[i] * Math.abs(after[at] - before[at]);
    total += 3 * weights[i];
  }
  return total ? sum / total : 0;
}
