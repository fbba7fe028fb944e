// The marks of a photo: brush strokes and rectangles. Marks of the kind "protect" are drawn into a
// mask like that of `--mask FILE` on the command line: what they cover stays as it is. Marks of the
// kinds "reflection" and "scene" are drawn into an image like that of `--hints FILE`.
//
// A mark is {shape: "brush" | "rectangle", kind, points, radius, feather}. A mark replaces earlier
// ones at the same place; the kind "erase" does nothing else. Positions and lengths are fractions
// of the longer side of the photo. The points of a rectangle are two opposite corners.

import { crc32 } from "./zip.js";

const BAND_ROWS = 256; // number of rows of a mask that are computed at once for a file
const PNG_SIGNATURE = [0x89, 0x50, 0x4e, 0x47, 0x0d, 0x0a, 0x1a, 0x0a];

export const isHint = ({ kind }) => kind === "reflection" || kind === "scene";
const isProtection = ({ kind }) => kind === "protect";

// Returns the mask of the marks as codes, 0 (protected) to 255, or null if nothing is protected.
// The mask of the whole photo has `width` x `height` pixels; `part` selects a part of it: {left,
// top, columns, rows}.
export function maskCodes(
  list,
  width,
  height,
  part = { left: 0, top: 0, columns: width, rows: height },
) {
  if (!list.some(isProtection)) return null;
  return toCodes(
    list.map((mark) => [mark, Number(!isProtection(mark))]),
    1,
    width,
    height,
    part,
  );
}

// Returns where the marks are hints of this kind, as codes like those of `maskCodes`.
export function hintCodes(
  list,
  kind,
  width,
  height,
  part = { left: 0, top: 0, columns: width, rows: height },
) {
  return toCodes(
    list.map((mark) => [mark, Number(mark.kind === kind)]),
    0,
    width,
    height,
    part,
  );
}

function toCodes(drawn, outside, width, height, part) {
  const mask = new Float32Array(part.columns * part.rows).fill(outside);
  for (const [mark, value] of drawn) drawMark(mask, mark, value, Math.max(width, height), part);
  const codes = new Uint8Array(mask.length);
  for (let i = 0; i < codes.length; i++) codes[i] = 255 * mask[i] + 0.5;
  return codes;
}

function drawMark(mask, mark, value, scale, { left, top, columns, rows }) {
  const points = mark.points.map(([x, y]) => [x * scale - left - 0.5, y * scale - top - 0.5]);
  // at least one pixel, so that the edge is smooth
  const feather = Math.max(1, mark.feather * scale);
  const radius = mark.shape === "brush" ? mark.radius * scale : 0;
  const reach = radius + feather / 2 + 1;
  const limit = (values, end) => [
    Math.max(0, Math.floor(Math.min(...values) - reach)),
    Math.min(end - 1, Math.ceil(Math.max(...values) + reach)),
  ];
  const [x0, x1] = limit(
    points.map(([x]) => x),
    columns,
  );
  const [y0, y1] = limit(
    points.map(([, y]) => y),
    rows,
  );
  if (x0 > x1 || y0 > y1) return;
  const width = x1 - x0 + 1;
  // to the line or the rectangle, negative inside
  const distances = new Float32Array(width * (y1 - y0 + 1)).fill(Infinity);
  const box = { x0, y0, x1, y1, width };
  if (mark.shape === "rectangle") measureRectangle(distances, points, box);
  else
    for (let i = 0; i < points.length; i++)
      measureSegment(distances, points[Math.max(0, i - 1)], points[i], reach, box);
  for (let y = y0, at = 0; y <= y1; y++) {
    for (let x = x0, to = y * columns + x0; x <= x1; x++, to++, at++) {
      const cover = Math.min(1, Math.max(0, 0.5 + (radius - distances[at]) / feather));
      mask[to] += cover * (value - mask[to]);
    }
  }
}

// Replaces distances by those to a line segment where these are smaller. Only pixels within `reach`
// of the segment are changed.
function measureSegment(distances, [ax, ay], [bx, by], reach, { x0, y0, x1, y1, width }) {
  const [dx, dy] = [bx - ax, by - ay];
  const squared = dx * dx + dy * dy || 1;
  const [fromX, toX] = [
    Math.max(x0, Math.floor(Math.min(ax, bx) - reach)),
    Math.min(x1, Math.ceil(Math.max(ax, bx) + reach)),
  ];
  const [fromY, toY] = [
    Math.max(y0, Math.floor(Math.min(ay, by) - reach)),
    Math.min(y1, Math.ceil(Math.max(ay, by) + reach)),
  ];
  for (let y = fromY; y <= toY; y++) {
    for (let x = fromX, at = (y - y0) * width + fromX - x0; x <= toX; x++, at++) {
      const along = Math.min(1, Math.max(0, ((x - ax) * dx + (y - ay) * dy) / squared));
      const [px, py] = [ax + along * dx - x, ay + along * dy - y];
      const distance = Math.sqrt(px * px + py * py);
      if (distance < distances[at]) distances[at] = distance;
    }
  }
}

// Computes the signed distances to a rectangle.
function measureRectangle(distances, [[ax, ay], [bx, by]], { x0, y0, x1, y1 }) {
  const [left, right, top, bottom] = [
    Math.min(ax, bx),
    Math.max(ax, bx),
    Math.min(ay, by),
    Math.max(ay, by),
  ];
  for (let y = y0, at = 0; y <= y1; y++) {
    const down = Math.max(top - y, y - bottom);
    for (let x = x0; x <= x1; x++, at++) {
      const across = Math.max(left - x, x - right);
      const [outsideX, outsideY] = [Math.max(across, 0), Math.max(down, 0)];
      distances[at] =
        Math.sqrt(outsideX * outsideX + outsideY * outsideY) + Math.min(Math.max(across, down), 0);
    }
  }
}

// Returns the mask as a grey 8-bit PNG file of the size of the photo, or null if nothing is
// protected.
export async function maskFile(list, width, height) {
  if (!list.some(isProtection)) return null;
  return pngFile(width, height, (part) => [maskCodes(list, width, height, part)]);
}

// Returns the hints as an 8-bit PNG file of the size of the photo, red for the reflection and green
// for the scene, or null if there are none.
export async function hintsFile(list, width, height) {
  if (!list.some(isHint)) return null;
  const codes = (kind, part) => hintCodes(list, kind, width, height, part);
  return pngFile(width, height, (part) => [
    codes("reflection", part),
    codes("scene", part),
    new Uint8Array(part.columns * part.rows),
  ]);
}

// Writes a PNG file (PNG specification, third edition) from the codes of each channel of a part:
// one channel (grey), or three (RGB).
async function pngFile(width, height, channelsOf) {
  const compression = new CompressionStream("deflate");
  const compressed = new Response(compression.readable).arrayBuffer();
  const writer = compression.writable.getWriter();
  let count = 1;
  for (let top = 0; top < height; top += BAND_ROWS) {
    const rows = Math.min(BAND_ROWS, height - top);
    const channels = channelsOf({ left: 0, top, columns: width, rows });
    count = channels.length;
    // each line begins with the filter type 0
    const lines = new Uint8Array(rows * (count * width + 1));
    for (let row = 0, from = 0, to = 0; row < rows; row++) {
      to++;
      for (let column = 0; column < width; column++, from++)
        for (const codes of channels) lines[to++] = codes[from];
    }
    await writer.write(lines);
  }
  await writer.close();
  const header = new DataView(new ArrayBuffer(13));
  header.setUint32(0, width);
  header.setUint32(4, height);
  header.setUint8(8, 8); // bits
  header.setUint8(9, count === 3 ? 2 : 0); // colour type: RGB or grey
  const parts = [
    chunk("IHDR", new Uint8Array(header.buffer)),
    chunk("IDAT", new Uint8Array(await compressed)),
    chunk("IEND", new Uint8Array()),
  ];
  return new Blob([new Uint8Array(PNG_SIGNATURE), ...parts.flat()], { type: "image/png" });
}

function chunk(type, data) {
  const name = new TextEncoder().encode(type);
  const number = (value) => {
    const view = new DataView(new ArrayBuffer(4));
    view.setUint32(0, value);
    return view;
  };
  return [number(data.length), name, data, number(crc32(data, crc32(name)))];
}
