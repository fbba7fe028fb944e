// The image files of a drop, a paste or a file dialog, including those in dropped folders.

export const MAX_PHOTOS = 1000; // maximum number of photos in the list of the page
const compareNames = new Intl.Collator(undefined, { numeric: true }).compare;

// Returns {files, others, surplus}: the files to add in the order of their names, the number of
// files in folders that are not images, and the number of images beyond `room`. Files that are not
// in a folder are always kept, because the server explains why it cannot separate them. Call this
// in the event handler, because the browser empties the transfer after the event.
export async function readTransfer(transfer, isImage, room) {
  const items = [...transfer.items].filter((item) => item.kind === "file");
  const entries = items.map((item) => item.webkitGetAsEntry?.() ?? item.getAsFile());
  return collect(entries, isImage, room);
}

// Does the same as `readTransfer` for the files of an <input>. `isFolder`: whether the files are
// the content of a folder.
export function readList(list, isImage, room, isFolder) {
  const files = [...list];
  const images = isFolder ? files.filter((file) => isImage(file.name)) : files;
  return {
    files: images.slice(0, room),
    others: files.length - images.length,
    surplus: Math.max(0, images.length - room),
  };
}

async function collect(entries, isImage, room) {
  const found = [];
  let others = 0;
  async function visit(entry, isInFolder) {
    if (entry.isDirectory) {
      const children = await childrenOf(entry);
      for (const child of children.sort((one, other) => compareNames(one.name, other.name)))
        await visit(child, true);
    } else if (!isInFolder || isImage(entry.name)) found.push(entry);
    else others++;
  }
  for (const entry of entries) if (entry) await visit(entry, false);
  const files = await Promise.all(found.slice(0, room).map(toFile));
  return { files, others, surplus: Math.max(0, found.length - room) };
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
  entry instanceof File ? entry : new Promise((resolve, reject) => entry.file(resolve, reject));

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
