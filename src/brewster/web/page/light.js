// Reads a preview (web/preview.py) and computes the layers of the reduced photo and of tiles, at
// any strength and with any mask, in linear light.

const STEPS = 1 << 14;
const LINEAR = Float32Array.from({ length: 256 }, (_, code) => toLinear(code / 255));
const CODES = Uint8Array.from({ length: STEPS + 1 }, (_, step) =>
  Math.round(255 * toEncoded(step / STEPS)),
);

// The colours of the confidence map. Each row is [opacity over the grey photo, red, green, blue].
// The first row is confidence 1, the last row is confidence 0.
const HEAT_STOPS = [
  [0, 250, 204, 70],
  [0.55, 250, 190, 60],
  [0.75, 226, 84, 48],
  [0.88, 128, 20, 100],
];
const HEAT = Float32Array.from({ length: 4 * 256 }, (_, i) => {
  const at = ((255 - (i >> 2)) / 255) * (HEAT_STOPS.length - 1);
  const index = Math.min(Math.floor(at), HEAT_STOPS.length - 2);
  return (
    HEAT_STOPS[index][i & 3] +
    (at - index) * (HEAT_STOPS[index + 1][i & 3] - HEAT_STOPS[index][i & 3])
  );
});

// The sRGB curve, IEC 61966-2-1.
function toLinear(encoded) {
  return encoded <= 0.04045 ? encoded / 12.92 : ((encoded + 0.055) / 1.055) ** 2.4;
}

function toEncoded(linear) {
  return linear <= 0.0031308 ? linear * 12.92 : 1.055 * linear ** (1 / 2.4) - 0.055;
}

// Parses a preview, a Blob that is compressed with gzip. Returns its head, `photo` (8-bit codes of
// the reduced photo) and `maps` by name: {width, height, channels, values}.
export async function readPreview(blob) {
  const buffer = await new Response(
    blob.stream().pipeThrough(new DecompressionStream("gzip")),
  ).arrayBuffer();
  const bytes = new Uint8Array(buffer);
  const start = bytes.indexOf(10) + 1; // the first line has the result, see `readHead`
  const end = bytes.indexOf(10, start);
  const head = JSON.parse(new TextDecoder().decode(buffer.slice(start, end)));
  let at = end + 1;
  const read = (kind, length) => {
    const from = at;
    at += length * kind.BYTES_PER_ELEMENT;
    return new kind(buffer.slice(from, at));
  };
  const photo = read(Uint8Array, 3 * head.width * head.height);
  const maps = {};
  for (const map of head.maps) {
    const numbers = read(Uint16Array, map.width * map.height * map.channels);
    const [low, high] = map.range;
    maps[map.name] = {
      ...map,
      values: Float32Array.from(numbers, (number) => low + (number / 65535) * (high - low)),
    };
  }
  return { ...head, photo, maps };
}

// Returns the first line of a preview: {result, size, takes_hints}.
export async function readHead(blob) {
  const reader = blob
    .stream()
    .pipeThrough(new DecompressionStream("gzip"))
    .pipeThrough(new TextDecoderStream())
    .getReader();
  let text = "";
  while (!text.includes("\n")) text += (await reader.read()).value;
  await reader.cancel();
  return JSON.parse(text.slice(0, text.indexOf("\n")));
}

// The layers of a part of a photo. They are computed when they are needed.
export class Layers {
  #change = null;
  #reflection = null;
  #confidence = null;

  // `preview`: the result of `readPreview`; `photo`: the 8-bit codes of the part; `area`: the
  // position of its upper left corner and the size of its pixels, in pixels of the full photo.
  constructor(preview, photo, width, height, area) {
    Object.assign(this, { preview, photo, width, height, area });
  }

  // Returns the layers of the whole reduced photo.
  static ofPreview(preview) {
    const { photo, width, height, full } = preview;
    return new Layers(preview, photo, width, height, {
      left: 0,
      top: 0,
      stepX: full[0] / width,
      stepY: full[1] / height,
    });
  }

  // The change at strength 1: transmission - photo, in linear light.
  get change() {
    const { change_slope, change_offset, generated, weight } = this.preview.maps;
    if (!this.#change) {
      this.#change = this.#apply(change_slope, change_offset);
      if (weight)
        this.#override(this.#change, this.#upsample(generated, 3), this.#upsample(weight, 1));
    }
    return this.#change;
  }

  // The reflection at strength 1, in linear light: photo - transmission if the model gives no
  // reflection.
  get reflection() {
    const { reflection_slope, reflection_offset } = this.preview.maps;
    this.#reflection ??= reflection_slope
      ? this.#apply(reflection_slope, reflection_offset)
      : this.change.map((value) => -value);
    return this.#reflection;
  }

  // The confidence as 8-bit codes.
  get confidence() {
    this.#confidence ??= Uint8Array.from(this.#upsample(this.preview.maps.confidence, 1), (value) =>
      Math.round(255 * value),
    );
    return this.#confidence;
  }

  // Returns slope x photo + offset, with slope and offset upsampled to the pixels of this part.
  #apply(slope, offset) {
    const layer = this.#upsample(slope, 3);
    const offsets = this.#upsample(offset, 3);
    for (let i = 0; i < layer.length; i++) layer[i] = layer[i] * LINEAR[this.photo[i]] + offsets[i];
    return layer;
  }

  // Blends the change with (generated transmission - photo). Weight 0 keeps the change, weight 1
  // replaces it.
  #override(change, generated, weight) {
    for (let i = 0; i < change.length; i++) {
      change[i] += weight[(i / 3) | 0] * (generated[i] - LINEAR[this.photo[i]] - change[i]);
    }
  }

  // Upsamples a map to the pixels of this part by bilinear interpolation. A map of one channel is
  // repeated to `channels` channels.
  #upsample({ width, height, channels: stored, values }, channels) {
    const { left, top, stepX, stepY } = this.area;
    const across = positions(width, this.width, left, stepX, this.preview.full[0]);
    const down = positions(height, this.height, top, stepY, this.preview.full[1]);
    const out = new Float32Array(this.width * this.height * channels);
    const source =
      stored === channels
        ? values
        : Float32Array.from(
            { length: width * height * channels },
            (_, i) => values[(i / channels) | 0],
          );
    // the map, interpolated at the height of one row of the result
    const line = new Float32Array(width * channels);
    for (let row = 0, at = 0; row < this.height; row++) {
      const upper = down.lower[row] * line.length;
      const lower = Math.min(down.lower[row] + 1, height - 1) * line.length;
      for (let i = 0; i < line.length; i++) {
        line[i] = source[upper + i] + down.fraction[row] * (source[lower + i] - source[upper + i]);
      }
      for (let column = 0; column < this.width; column++) {
        const from = across.lower[column] * channels;
        const to = Math.min(across.lower[column] + 1, width - 1) * channels;
        for (let channel = 0; channel < channels; channel++, at++) {
          out[at] =
            line[from + channel] +
            across.fraction[column] * (line[to + channel] - line[from + channel]);
        }
      }
    }
    return out;
  }
}

// Returns the positions of `count` pixels in a map with `small` pixels, as integer and fractional
// parts (see guided_upsampling.py).
function positions(small, count, start, step, full) {
  const lower = new Int32Array(count);
  const fraction = new Float32Array(count);
  for (let i = 0; i < count; i++) {
    const centre = Math.min(
      Math.max((start + (i + 0.5) * step) * (small / full) - 0.5, 0),
      small - 1,
    );
    lower[i] = Math.min(Math.floor(centre), Math.max(small - 2, 0));
    fraction[i] = centre - lower[i];
  }
  return { lower, fraction };
}

// Each view has a function. It returns a second function, which maps the index of a value (three
// values per pixel) to an 8-bit code. `weights` is the mask in 8-bit codes, one per pixel, or null.
const VIEWS = {
  photo:
    ({ photo }) =>
    (i) =>
      photo[i],
  transmission({ photo, change }, strength, weights) {
    if (!weights) return (i) => code(LINEAR[photo[i]] + strength * change[i]);
    return (i) => code(LINEAR[photo[i]] + (strength / 255) * weights[(i / 3) | 0] * change[i]);
  },
  reflection({ photo, reflection }, strength, weights) {
    if (!weights) return (i) => code(Math.min(strength * reflection[i], LINEAR[photo[i]]));
    return (i) =>
      code(Math.min((strength / 255) * weights[(i / 3) | 0] * reflection[i], LINEAR[photo[i]]));
  },
  confidence({ photo, confidence }) {
    return (i) => {
      const pixel = i - (i % 3);
      const heat = 4 * confidence[pixel / 3];
      const grey = 0.2126 * photo[pixel] + 0.7152 * photo[pixel + 1] + 0.0722 * photo[pixel + 2];
      return grey + HEAT[heat] * (HEAT[heat + 1 + i - pixel] - grey);
    };
  },
};

// Draws a view of layers at a strength of 0 to 1. Resizes the canvas to the size of the layers.
export function draw(canvas, layers, view, strength, weights = null) {
  canvas.width = layers.width;
  canvas.height = layers.height;
  const context = canvas.getContext("2d", { willReadFrequently: true });
  const image = context.createImageData(layers.width, layers.height);
  const codeAt = VIEWS[view](layers, strength, weights);
  for (let to = 0, from = 0; to < image.data.length; to += 4, from += 3) {
    image.data[to] = codeAt(from);
    image.data[to + 1] = codeAt(from + 1);
    image.data[to + 2] = codeAt(from + 2);
    image.data[to + 3] = 255;
  }
  context.putImageData(image, 0, 0);
}

function code(linear) {
  return CODES[linear <= 0 ? 0 : linear >= 1 ? STEPS : (linear * STEPS + 0.5) | 0];
}
