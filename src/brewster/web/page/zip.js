// Merges the zips of the server into one. Their files are uncompressed, and the local headers
// contain the sizes.

// The signatures of the three kinds of records.
const LOCAL = 0x04034b50;
const CENTRAL = 0x02014b50;
const END = 0x06054b50;
const MAX_BYTES = 0xffffffff; // maximum size of a zip without the ZIP64 extension

const CRC_TABLE = Uint32Array.from({ length: 256 }, (_, byte) => {
  for (let bit = 0; bit < 8; bit++) byte = byte & 1 ? 0xedb88320 ^ (byte >>> 1) : byte >>> 1;
  return byte;
});

// Returns the CRC-32 of zip and PNG (ISO 3309). `crc` is the value for the preceding bytes.
export function crc32(bytes, crc = 0) {
  crc = ~crc;
  for (let i = 0; i < bytes.length; i++) crc = CRC_TABLE[(crc ^ bytes[i]) & 0xff] ^ (crc >>> 8);
  return ~crc >>> 0;
}

// Returns the files with unique names: a number is put before a name that is already used.
export function withUniqueNames(files) {
  const usedNames = new Set();
  return files.map((file) => ({ ...file, name: uniqueName(file.name, usedNames) }));
}

// Creates a zip from files as returned by `readZip`. Their names must be unique.
export function createZip(files) {
  const parts = [];
  const centralRecords = [];
  let at = 0;
  for (const file of files) {
    const name = new TextEncoder().encode(file.name);
    const common = commonFields(file, name.length);
    const local = concatenate(littleEndian([[4, LOCAL]]), common, littleEndian([[2, 0]]), name);
    const centralFields = [
      [2, 0],
      [2, 0],
      [2, 0],
      [2, 0],
      [4, 0],
      [4, at],
    ];
    centralRecords.push(
      concatenate(
        littleEndian([
          [4, CENTRAL],
          [2, 20],
        ]),
        common,
        littleEndian(centralFields),
        name,
      ),
    );
    parts.push(local, file.data);
    at += local.length + file.data.byteLength;
  }
  const size = centralRecords.reduce((sum, row) => sum + row.length, 0);
  if (at + size > MAX_BYTES)
    throw new Error("The zip would be larger than 4 GB. Download the photos one by one.");
  const count = [
    [2, centralRecords.length],
    [2, centralRecords.length],
  ];
  const end = littleEndian([[4, END], [2, 0], [2, 0], ...count, [4, size], [4, at], [2, 0]]);
  return new Blob([...parts, ...centralRecords, end], { type: "application/zip" });
}

// Returns the files of a zip as {name, crc, data}.
export function readZip(buffer) {
  const view = new DataView(buffer);
  const files = [];
  for (let at = 0; view.getUint32(at, true) === LOCAL; ) {
    const size = view.getUint32(at + 18, true);
    const name = at + 30;
    const data = name + view.getUint16(at + 26, true) + view.getUint16(at + 28, true);
    files.push({
      name: new TextDecoder().decode(buffer.slice(name, name + view.getUint16(at + 26, true))),
      crc: view.getUint32(at + 14, true),
      data: buffer.slice(data, data + size),
    });
    at = data + size;
  }
  return files;
}

// Version 2.0, names in UTF-8, stored, 1 January 1980 (APPNOTE 4.4).
function commonFields({ crc, data }, nameLength) {
  const size = data.byteLength;
  return littleEndian([
    [2, 20],
    [2, 0x800],
    [2, 0],
    [2, 0],
    [2, 0x21],
    [4, crc],
    [4, size],
    [4, size],
    [2, nameLength],
  ]);
}

function uniqueName(name, usedNames) {
  let unique = name;
  for (let number = 2; usedNames.has(unique); number++) unique = `${number}-${name}`;
  usedNames.add(unique);
  return unique;
}

function littleEndian(fields) {
  const view = new DataView(new ArrayBuffer(fields.reduce((sum, [size]) => sum + size, 0)));
  let at = 0;
  for (const [size, value] of fields) {
    if (size === 2) view.setUint16(at, value, true);
    else view.setUint32(at, value, true);
    at += size;
  }
  return new Uint8Array(view.buffer);
}

function concatenate(...parts) {
  return Uint8Array.from(parts.flatMap((part) => [...part]));
}
