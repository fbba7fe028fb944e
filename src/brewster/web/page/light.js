// Reads the maps of web/preview.py and computes the layers at any strength, in linear light.

const STEPS = 1 << 14;
const LINEAR = Float32Array.from({ length: 256 }, (_, code) => toLinear(code / 255));
const CODES = Uint8Array.from({ length: STEPS + 1 }, (_, step) => Math.round(255 * toEncoded(step / STEPS)));

// The sRGB curve, IEC 61966-2-1.
function toLinear(encoded) {
  return encoded <= 0.04045 ? encoded / 12.92 : ((encoded + 0.055) / 1.055) ** 2.4;
}

function toEncoded(linear) {
  return linear <= 0.0031308 ? linear * 12.92 : 1.055 * linear ** (1 / 2.4) - 0.055;
}

// Parses the maps of a preview, a Blob that is compressed with gzip. `photo`, `reflection` and `confidence_map` are 8-bit codes; `change` is the transmission at
// strength 1 minus the photo, in linear light.
export async function readMaps(blob) {
  const buffer = await new Response(blob.stream().pipeThrough(new DecompressionStream("gzip"))).arrayBuffer();
  const end = new Uint8Array(buffer).indexOf(10);
  const head = JSON.parse(new TextDecoder().decode(buffer.slice(0, end)));
  const count = head.width * head.height;
  let offset = end + 1;
  const read = (kind, length) => {
    const bytes = length * kind.BYTES_PER_ELEMENT;
    offset += bytes;
    return new kind(buffer.slice(offset - bytes, offset));
  };
  const photo = read(Uint8Array, 3 * count);
  const numbers = read(Uint16Array, 3 * count);
  const reflection = read(Uint8Array, 3 * count);
  const [lowest, highest] = head.range;
  const change = new Float32Array(3 * count);
  for (let i = 0; i < change.length; i++) {
    change[i] = lowest + (numbers[i] / 65535) * (highest - lowest) - LINEAR[photo[i]];
  }
  return { ...head, photo, change, reflection, confidence_map: read(Uint8Array, count) };
}

const VIEWS = {
  photo: (maps) => (i) => maps.photo[i],
  transmission: ({ photo, change }, strength) => (i) => code(LINEAR[photo[i]] + strength * change[i]),
  reflection: ({ photo, reflection }, strength) => (i) =>
    code(Math.min(strength * LINEAR[reflection[i]], LINEAR[photo[i]])),
  confidence: ({ confidence_map }) => (i) => confidence_map[(i / 3) | 0],
};

// Draws a view of the maps at a strength of 0 to 1. Resizes the canvas to the size of the maps.
export function draw(canvas, maps, view, strength) {
  canvas.width = maps.width;
  canvas.height = maps.height;
  const context = canvas.getContext("2d", { willReadFrequently: true });
  const image = context.createImageData(maps.width, maps.height);
  const codeAt = VIEWS[view](maps, strength);
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
