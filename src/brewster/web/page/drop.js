// The image files of a drop, a paste or a file dialog, including those in dropped folders.

export const MAX_PHOTOS = 1000; // maximum number of photos in the list of the page
const compareNames = new Intl.Collator(undefined, { numeric: true }).compare;

// Returns {files, films, others, surplus}: the files to add in the order of their names, a Map from
// a photo to its film (IMG_1.HEIC and IMG_1.MOV of one folder), the number of files in folders that
// are not images, and the number of images beyond `room`. Files that are not in a folder are always
// kept, because the server explains why it cannot separate them. Call this in the event handler,
// because the browser empties the transfer after the event.
export async function readTransfer(transfer, isImage, room) {
  const items = [...transfer.items].filter((item) => item.kind === "file");
  const entries = items.map((item) => item.webkitGetAsEntry?.() ?? item.getAsFile());
  return collect(entries, isImage, room);
}

// Does the same as `readTransfer` for the files of an <input>. `isFolder`: whether the files are
// the content of a folder.
export function readList(list, isImage, room, isFolder) {
  const { alone, films } = withoutFilms([...list], isImage, (file) => file.webkitRelativePath);
  const images = isFolder ? alone.filter((file) => isImage(file.name)) : alone;
  return {
    files: images.slice(0, room),
    films,
    others: alone.length - images.length,
    surplus: Math.max(0, images.length - room),
  };
}

async function collect(entries, isImage, room) {
  const found = [];
  const inFolders = new Set();
  async function visit(entry, isInFolder) {
    if (entry.isDirectory) {
      const children = await childrenOf(entry);
      for (const child of children.sort((one, other) => compareNames(one.name, other.name)))
        await visit(child, true);
      return;
    }
    found.push(entry);
    if (isInFolder) inFolders.add(entry);
  }
  for (const entry of entries) if (entry) await visit(entry, false);
  const { alone, films } = withoutFilms(found, isImage, (entry) => entry.fullPath ?? "");
  const kept = alone.filter((entry) => !inFolders.has(entry) || isImage(entry.name));
  const added = kept.slice(0, room);
  const files = await Promise.all(added.map(toFile));
  const filmFiles = await Promise.all(added.map((entry) => films.get(entry)).map(toFile));
  return {
    files,
    films: new Map(files.map((file, index) => [file, filmFiles[index]])),
    others: alone.length - kept.length,
    surplus: Math.max(0, kept.length - room),
  };
}

// Returns {alone, films}: the files without the films of photos, and a Map from a photo to its
// film. A film has the name of the photo, and is in its folder. `pathOf(file)` is its path.
function withoutFilms(files, isImage, pathOf) {
  const folderOf = (file) => pathOf(file).split("/").slice(0, -1).join("/");
  const stemOf = ({ name }) => name.replace(/\.[^.]*$/, "").toLowerCase();
  const keyOf = (file) => `${folderOf(file)}/${stemOf(file)}`;
  const isFilm = (file) => isVideo({ name: file.name, type: file.type ?? "" });
  const byKey = new Map(files.filter(isFilm).map((file) => [keyOf(file), file]));
  const films = new Map();
  for (const file of files)
    if (isImage(file.name) && byKey.has(keyOf(file))) films.set(file, byKey.get(keyOf(file)));
  const used = new Set(films.values());
  return { alone: files.filter((file) => !used.has(file)), films };
}

// Returns the entries of a folder. `readEntries` returns batches of entries; the last batch is
// empty.
async function childrenOf(folder) {
  const reader = folder.createReader();
  const children = [];
  for (;;) {
    const batch = await new Promise((resolve, reject) => reader.readEntries(resolve, reject));
    if (!batch.length) return children;
    children.push(...batch);
  }
}

const VIDEO_SUFFIX = /\.(mp4|m4v|mov|avi|mkv|webm|mts|m2ts|mpg|mpeg|3gp|3g2|wmv|flv)$/i;

export const isVideo = ({ name, type }) => type.startsWith("video/") || VIDEO_SUFFIX.test(name);

const toFile = (entry) =>
  !entry || entry instanceof File
    ? entry
    : new Promise((resolve, reject) => entry.file(resolve, reject));

// Returns one sentence about the files that were added and left out.
export function describeAdded({ files, others, surplus }) {
  const parts = [
    files.length === 1 ? `${files[0].name} was added` : `${files.length} photos were added`,
  ];
  if (others) parts.push(`${others} other ${others === 1 ? "file was" : "files were"} left out`);
  if (surplus)
    parts.push(
      `${surplus} more photos were left out, because the list can contain at most ${MAX_PHOTOS}; ` +
        "use the command line for these photos",
    );
  return `${parts.join("; ")}.`;
}

// Calls `onTransfer(transfer)` for files that are dropped on the page or pasted.
export function watchTransfers(onTransfer) {
  document.addEventListener("paste", (event) => onTransfer(event.clipboardData));
  document.addEventListener("dragover", (event) => {
    event.preventDefault();
    document.body.classList.add("drag-over");
  });
  document.addEventListener("dragleave", (event) => {
    if (!event.relatedTarget) document.body.classList.remove("drag-over");
  });
  document.addEventListener("drop", (event) => {
    event.preventDefault();
    document.body.classList.remove("drag-over");
    onTransfer(event.dataTransfer);
  });
}
