// The image files of a drop, a paste or a file dialog, including those in dropped folders.

export const MAX_PHOTOS = 1000; // in the list of the page; more files are a task for the command line
const compareNames = new Intl.Collator(undefined, { numeric: true }).compare;

// Returns {files, others, surplus}: the files to add in the order of their names, the number of files in folders that are no
// images, and the number of images beyond `room`. Files that are passed directly are always kept: the server names their problem.
// Must be called in the event handler, because the browser empties the transfer after it.
export async function readTransfer(transfer, isImage, room) {
  const items = [...transfer.items].filter((item) => item.kind === "file");
  const entries = items.map((item) => item.webkitGetAsEntry?.() ?? item.getAsFile());
  return collect(entries, isImage, room);
}

// As `readTransfer`, for the files of an <input>. `isFolder`: they are the content of a folder.
export function readList(list, isImage, room, isFolder) {
  const files = [...list];
  const images = isFolder ? files.filter((file) => isImage(file.name)) : files;
  return { files: images.slice(0, room), others: files.length - images.length, surplus: Math.max(0, images.length - room) };
}

async function collect(entries, isImage, room) {
  const found = [];
  let others = 0;
  async function visit(entry, isInFolder) {
    if (entry.isDirectory) {
      const children = await childrenOf(entry);
      for (const child of children.sort((one, other) => compareNames(one.name, other.name))) await visit(child, true);
    } else if (!isInFolder || isImage(entry.name)) found.push(entry);
    else others++;
  }
  for (const entry of entries) if (entry) await visit(entry, false);
  const files = await Promise.all(found.slice(0, room).map(toFile));
  return { files, others, surplus: Math.max(0, found.length - room) };
}

// The entries of a folder. `readEntries` returns them in batches, the last of which is empty.
async function childrenOf(folder) {
  const reader = folder.createReader();
  const children = [];
  for (;;) {
    const batch = await new Promise((resolve, reject) => reader.readEntries(resolve, reject));
    if (!batch.length) return children;
    children.push(...batch);
  }
}

const toFile = (entry) => (entry instanceof File ? entry : new Promise((resolve, reject) => entry.file(resolve, reject)));

// One sentence about what was added and what was left out.
export function describeAdded({ files, others, surplus }) {
  const parts = [files.length === 1 ? `${files[0].name} was added` : `${files.length} photos were added`];
  if (others) parts.push(`${others} other ${others === 1 ? "file was" : "files were"} left out`);
  if (surplus) parts.push(`${surplus} more photos were left out, because the list holds at most ${MAX_PHOTOS}; use the command line for them`);
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
