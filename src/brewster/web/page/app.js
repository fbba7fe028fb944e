// The page that separates photos: its controls, and the view of the current photo.

import "./compare.js";
import { models, send } from "./api.js";
import { MAX_PHOTOS, describeAdded, readList, readTransfer, watchTransfers } from "./drop.js";
import { exportAll, exportLayer, save } from "./export.js";
import { Layers, draw, readPreview } from "./light.js";
import { SeparationQueue } from "./queue.js";
import { Edits, hintsFile, maskCodes, maskFile } from "./marks.js";
import {
  createThumbnail,
  fraction,
  progressText,
  setBar,
  showDecoded,
  showFile,
  showOneScene,
  statusText,
  summarise,
  updateThumbnail,
  watchScrolling,
} from "./filmstrip.js";
import {
  forgetAll,
  forgetPhoto,
  keepEdits,
  keepPhoto,
  keepResult,
  keepSettings,
  readSession,
} from "./session.js";
import { TileSet } from "./tiles.js";
import { createTools } from "./tools.js";
import { describeVerdict, isNamingOpen, verdictOf } from "./verdict.js";

const LAYER_DESCRIPTIONS = {
  transmission: "The scene behind the glass.",
  reflection: "The light that the glass reflects.",
  confidence:
    "How certain the separation is. The file that you download is grey: white is certain.",
};
const EXAMPLE = "page/example.jpg";
const WAIT_MS = 200; // how often a zip checks whether all photos are separated
const RETRY_MODELS_MS = 3000;
const MAX_BURST_PHOTOS = 15;

const byId = (id) => document.getElementById(id);
const compare = byId("compare");
let shown = null; // the current photo: {photo, preview, layers, mask: {list, codes}}
let removed = null; // {photo, index} of the photo that was removed last
let isPaintScheduled = false;
let candidates = []; // the photos that may be a burst: they are held until it is known
let exporting = null; // the AbortController of the running download

// --- settings

const chosen = (name) => document.querySelector(`input[name=${name}]:checked`).value;
const settings = () => ({ quality: chosen("quality"), model: byId("model").value });
const queue = new SeparationQueue(settings, { onChange: refresh, onEnd: finish });
const exportSettings = () => ({
  ...settings(),
  takesHints: queue.hintModels.has(byId("model").value),
});
const tools = createTools({
  onEdit: () => onEdit(),
  onPaint: () => compare.paint(),
  saveMarks,
  announce,
});
compare.editor = tools.editor;

function applySettings() {
  keepSettings(settings());
  queue.applySettings();
  refresh();
  show();
}

// Applies the edits of a photo. Its files must then be downloaded again.
function onEdit(photo = queue.current) {
  photo.isSaved = false;
  keepEdits(photo);
  queue.applyEdits(photo);
  if (photo !== queue.current) return;
  byId("strength").value = photo.edits.strength;
  tools.update();
  paint();
  refresh();
}

function edit(values) {
  queue.current.edits.change(values);
  onEdit();
}

// Saves the marks in the form of the options --mask and --hints of the command line.
async function saveMarks() {
  const { file, edits, size } = queue.current;
  const stem = isImage(file.name) ? file.name.replace(/\.[^.]*$/, "") : file.name;
  for (const [kind, createFile] of [
    ["mask", maskFile],
    ["hints", hintsFile],
  ]) {
    const png = await createFile(edits.list, ...size);
    if (png) save(`${stem}.${kind}.png`, png);
  }
}

// Repeats the request until the server responds, because no photo can be separated before.
async function loadModels() {
  for (;;) {
    try {
      const rows = await models();
      byId("model").append(
        ...rows.map(
          ({ name, seconds }) =>
            new Option(seconds ? `${name}, about ${Math.round(seconds)} s a photo` : name, name),
        ),
      );
      queue.versions = Object.fromEntries(rows.map(({ name, version }) => [name, version]));
      break;
    } catch {
      announce("The server does not respond. The page tries again.");
      byId("status").textContent = byId("announcement").textContent;
      await new Promise((resolve) => setTimeout(resolve, RETRY_MODELS_MS));
    }
  }
  byId("model-field").hidden = byId("model").options.length < 2;
  await restore();
  queue.isReady = true;
  queue.startNext();
}

// Shows the photos, results and settings again that this browser kept.
async function restore() {
  const { photos, settings: kept } = await readSession();
  if (kept && [...byId("model").options].some(({ value }) => value === kept.model)) {
    byId("model").value = kept.model;
    document.querySelector(`input[name=quality][value=${kept.quality}]`).checked = true;
  }
  const added = queue.photos.length;
  for (const { id, file, burst, history, result } of photos.slice(0, room())) {
    // added while the models were loaded
    if (queue.photos.some((photo) => photo.id === id)) continue;
    const photo = queue.add(file, burst);
    insert(Object.assign(photo, { id, edits: new Edits(history), isKept: true }));
    if (!result) continue;
    queue.reuse(photo, result);
    showDecoded(photo);
  }
  if (queue.photos.length === added) return;
  if (queue.current === null) select(queue.photos[0]);
  else refresh();
  announce("The photos of your last visit are here again.");
}

async function forget() {
  if (!window.confirm("Forget all photos, marks and settings of this page?")) return;
  for (const photo of [...queue.photos]) {
    queue.remove(photo);
    photo.thumbnail.remove();
  }
  await forgetAll();
  removed = null;
  release();
  showNote("");
  select(null);
  announce("All photos, marks and settings are forgotten.");
  byId("choose").focus();
}

// --- adding and removing photos

const suffixes = byId("files")
  .accept.split(",")
  .filter((part) => part.startsWith("."));
const isImage = (name) => suffixes.some((suffix) => name.toLowerCase().endsWith(suffix));
const room = () => Math.max(0, MAX_PHOTOS - queue.photos.length);

function add(found) {
  const photos = found.files.map((file) => queue.add(file));
  const isFirst = queue.current === null;
  for (const photo of photos) insert(photo);
  if (!found.files.length && !found.others && !found.surplus) return;
  askForBurst(photos);
  announce(describeAdded(found));
  if (found.others || found.surplus) showNote(describeAdded(found));
  if (!photos.length) return refresh();
  select(photos[0]);
  if (isFirst) photos[0].thumbnail.querySelector("button").focus();
}

// Asks whether several photos are a burst, if they show one scene. None of them is separated before
// the answer.
async function askForBurst(photos) {
  if (
    photos.length < 2 ||
    photos.length > MAX_BURST_PHOTOS ||
    photos.some(({ isBurst }) => isBurst)
  )
    return;
  for (const photo of photos) photo.isHeld = true;
  release(); // the answer to a question that is still open is no
  candidates = photos;
  const isOneScene = await showOneScene(photos);
  if (candidates !== photos) return;
  if (!isOneScene) return release();
  byId("burst").hidden = false;
  refresh();
  announce(byId("burst-question").textContent);
}

// Separates the held photos one by one.
function release() {
  for (const photo of candidates) photo.isHeld = false;
  candidates = [];
  byId("burst").hidden = true;
  refresh();
  queue.startNext();
}

// Replaces photos in the list by others, and selects the first of these.
function replace(old, added) {
  for (const photo of old) {
    queue.remove(photo);
    forgetPhoto(photo);
    photo.thumbnail.remove();
  }
  for (const photo of added) insert(photo);
  select(added[0]);
  added[0].thumbnail.querySelector("button").focus();
}

function joinBurst() {
  const photos = candidates;
  const files = photos.map(({ file }) => file);
  // the middle photo is the reference photo of the server
  replace(photos, [queue.add(files[files.length >> 1], files)]);
  release();
}

function splitBurst() {
  const { current } = queue;
  replace(
    [current],
    current.burst.map((file) => queue.add(file)),
  );
}

function insert(photo, next = null) {
  photo.thumbnail = createThumbnail(
    photo,
    { onSelect: () => select(photo), onRemove: () => remove(photo) },
    next,
  );
  if (!photo.isKept) keepPhoto(photo);
}

function remove(photo) {
  const hadFocus =
    photo.thumbnail.contains(document.activeElement) ||
    byId("stage").contains(document.activeElement);
  const index = queue.remove(photo);
  forgetPhoto(photo);
  photo.isKept = false;
  if (candidates.includes(photo)) release();
  removed = { photo, index };
  photo.thumbnail.remove();
  if (photo === queue.current)
    select(queue.photos[Math.min(index, queue.photos.length - 1)] ?? null);
  showNote(`${photo.file.name} was removed.`);
  refresh();
  if (hadFocus)
    (queue.current ? queue.current.thumbnail.querySelector("button") : byId("undo-remove")).focus();
  announce(`${photo.file.name} was removed`);
  queue.startNext();
}

function undoRemove() {
  const { photo, index } = removed;
  removed = null;
  queue.restore(photo, index);
  insert(photo, queue.photos[index + 1]?.thumbnail ?? null);
  showNote("");
  select(photo);
  photo.thumbnail.querySelector("button").focus();
  announce(`${photo.file.name} was added again`);
}

// Shows a note above the list. While the photo that was removed last can be restored, the note has
// a button for this.
function showNote(text) {
  byId("removed-text").textContent = text;
  byId("removed").hidden = !text && removed === null;
  byId("undo-remove").hidden = removed === null;
}

async function addExample() {
  try {
    const response = await fetch(EXAMPLE);
    add(
      readList(
        [new File([await response.blob()], "example.jpg", { type: "image/jpeg" })],
        isImage,
        room(),
        false,
      ),
    );
  } catch {
    announce("The server does not respond. Start it again if it was stopped, then try again.");
  }
}

// --- the current photo

function finish(photo) {
  if (photo.state === "done") {
    keepResult(photo);
    showDecoded(photo);
    announceResult(`${photo.file.name} is separated: ${verdictOf(photo)}`);
  }
  if (photo.error) announceResult(`${photo.file.name} failed`);
  if (photo === queue.current) show();
}

function announce(message) {
  byId("announcement").textContent = message;
}

function announceResult(message) {
  announce(
    queue.photos.length > 1
      ? `${message}, ${queue.count("done")} of ${queue.photos.length} are done`
      : message,
  );
}

function select(photo) {
  queue.current = photo;
  close();
  for (const other of queue.photos)
    other.thumbnail.querySelector(".pick").removeAttribute("aria-current");
  if (photo) {
    photo.thumbnail.querySelector(".pick").setAttribute("aria-current", "true");
    photo.thumbnail.scrollIntoView({ block: "nearest", inline: "nearest" });
    byId("strength").value = photo.edits.strength;
    showFile(byId("thumbnail"), photo.file);
    compare.reset();
    paint();
  }
  refresh();
  show();
  queue.startNext();
}

// Shows no photo.
function close() {
  shown = null;
  compare.tiles?.close();
  compare.tiles = null;
  compare.isBefore = false;
  byId("before").setAttribute("aria-pressed", false);
  tools.show(null);
}

async function show() {
  const photo = queue.current;
  if (photo?.state !== "done") return;
  const preview = await readPreview(photo.preview);
  // another photo was selected in the meantime
  if (photo !== queue.current || photo.state !== "done") return;
  const isUpdate = shown?.photo === photo;
  if (isUpdate) compare.tiles?.close();
  else close();
  shown = { photo, preview, layers: Layers.ofPreview(preview), mask: { list: null, codes: null } };
  draw(compare.left, shown.layers, "photo");
  compare.fullSize = preview.full;
  if (preview.full[0] > preview.width) compare.tiles = tilesOf(photo, preview);
  tools.offerHints(queue.takesHints(photo));
  if (!isUpdate) tools.show(photo.edits, preview.full); // a mark that is being drawn goes on
  refresh();
  paint();
}

// Returns the tiles of a photo.
function tilesOf(photo, preview) {
  const context = { signal: new AbortController().signal, onProgress() {} };
  return new TileSet(preview, photo.key, {
    resend: () => send("photo", photo.file, {}, context),
    drawPhoto: (canvas, layers) => draw(canvas, layers, "photo"),
    drawRight(canvas, layers, part) {
      const [width, height] = preview.full.map((side) => side / 2 ** part.level);
      draw(
        canvas,
        layers,
        chosen("view"),
        photo.edits.strength,
        maskCodes(photo.edits.list, width, height, part),
      );
    },
    onChange: () => compare.paint(),
  });
}

// Returns the mask of the marks at the size of the reduced photo.
function currentMask() {
  const { list } = queue.current.edits;
  const { width, height } = shown.preview;
  if (shown.mask.list !== list) shown.mask = { list, codes: maskCodes(list, width, height) };
  return shown.mask.codes;
}

function paint() {
  byId("amount").textContent = `${Math.round(100 * byId("strength").value)} %`;
  byId("layer-description").textContent = LAYER_DESCRIPTIONS[chosen("view")];
  byId("legend").hidden = chosen("view") !== "confidence";
  byId("download").textContent = `Download ${chosen("view")}`;
  if (!shown || isPaintScheduled) return;
  isPaintScheduled = true;
  requestAnimationFrame(() => {
    isPaintScheduled = false;
    if (!shown) return;
    draw(compare.right, shown.layers, chosen("view"), queue.current.edits.strength, currentMask());
    compare.version = `${chosen("view")} ${JSON.stringify(queue.current.edits.now)}`;
    compare.show(queue.current.file.name, chosen("view"));
  });
}

function refresh(photo = null) {
  for (const one of photo ? [photo] : queue.photos) if (one.thumbnail) updateThumbnail(one);
  const { current } = queue;
  enable(
    "all",
    exporting === null && queue.count("done") + queue.pendingCount > 0 && zipLayers().length > 0,
  );
  byId("retry-all").hidden = queue.retriable.length < 2;
  byId("summary").textContent = queue.photos.length ? summarise(queue) : "";
  if (photo && photo !== current) return;
  const hasPhoto = current !== null;
  byId("welcome").hidden = hasPhoto;
  for (const id of ["stage", "panel", "add", "forget"]) byId(id).hidden = !hasPhoto;
  byId("strip").hidden = !hasPhoto && byId("removed").hidden;
  if (!hasPhoto) return;
  const isReady = (current.state === "done" || current.isUpdating) && shown !== null;
  const focusedPart = [byId("waiting"), byId("error")].find((part) =>
    part.contains(document.activeElement),
  );
  compare.hidden = byId("modes").hidden = !isReady;
  byId("error").hidden = current.state !== "failed";
  byId("waiting").hidden = isReady || current.state === "failed";
  if (focusedPart?.hidden)
    (isReady
      ? compare
      : byId(current.state !== "failed" ? "cancel" : current.error?.isFinal ? "discard" : "retry")
    ).focus();
  enable("download", isReady && !current.isUpdating && exporting === null);
  enable("copy", queue.photos.length > 1);
  byId("status").textContent = statusText(current);
  byId("bar").hidden = byId("cancel").hidden = current.isHeld === true;
  setBar(byId("bar"), fraction(current.progress));
  showLayersSoFar(current.progress?.layers);
  byId("error-title").textContent = current.error
    ? `${current.file.name} could not be separated`
    : "Cancelled";
  byId("error-text").textContent = current.error?.message ?? "";
  byId("retry").className = current.error?.isFinal ? "quiet" : "main";
  byId("discard").className = current.error?.isFinal ? "main" : "quiet";
  byId("error-details").hidden = !current.error?.details;
  byId("error-message").textContent = current.error?.details ?? "";
  byId("facts").textContent = isReady
    ? [
        `${current.size.join(" × ")} pixels.`,
        current.result.note && `Note: ${current.result.note}.`,
      ]
        .filter(Boolean)
        .join(" ")
    : "";
  byId("split").hidden = !current.burst;
  showVerdict(current, isReady);
}

// Shows the layers of a film that is still measured.
function showLayersSoFar(address) {
  const image = byId("so-far");
  image.hidden = !address;
  if (address && image.getAttribute("src") !== address) image.src = address;
}

// Shows the verdict below the picture, with what the user can do about it; and the question which
// of the measured layers is behind the glass.
function showVerdict(photo, isReady) {
  const { result, isUpdating } = photo;
  byId("verdict").hidden = !isReady;
  const isOpen = isReady && !isUpdating && isNamingOpen(photo);
  if (isOpen && byId("naming").hidden) {
    byId("naming").classList.toggle("wide", shown.preview.width > shown.preview.height);
    for (const layer of ["transmission", "reflection"])
      draw(byId(`name-${layer}`).querySelector("canvas"), shown.layers, layer, 1);
    announce(byId("naming-question").textContent);
  }
  byId("naming").hidden = !isOpen;
  if (!isReady) return;
  const { title, text } = describeVerdict(photo);
  byId("verdict-title").textContent = isUpdating ? statusText(photo) : title;
  byId("verdict-text").textContent = isUpdating ? "" : text;
  byId("update-bar").hidden = !isUpdating;
  setBar(byId("update-bar"), fraction(photo.progress));
  const isForced = photo.edits.now.method === "motion";
  byId("swap").hidden = result.method !== "burst";
  byId("measured").hidden = !isForced && !(result.isMeasured && result.method !== "burst");
  byId("measured").textContent = isForced
    ? "Show the automatic result"
    : "Use the measured layers anyway";
  byId("film-next").hidden = photo.isBurst || !result.nextStep;
}

// Uses aria-disabled, because a button with the attribute `disabled` loses the focus.
function enable(id, isEnabled) {
  byId(id).setAttribute("aria-disabled", !isEnabled);
}

const isEnabled = (button) => button.getAttribute("aria-disabled") !== "true";

// --- downloads

async function runExport(button, work) {
  if (!isEnabled(button)) return;
  exporting = new AbortController();
  byId("export-error").hidden = true;
  byId("export").hidden = false;
  refresh();
  try {
    const { name, blob, problem, saved } = await work(exporting.signal);
    save(name, blob);
    for (const photo of saved) photo.isSaved = true;
    announce(`${name} is ready`);
    showExportError(problem);
  } catch (error) {
    showExportError(error.name === "AbortError" ? "" : error.message);
  }
  exporting = null;
  if (byId("export").contains(document.activeElement)) button.focus();
  byId("export").hidden = true;
  refresh();
}

function showExportError(problem) {
  byId("export-error").textContent = problem;
  byId("export-error").hidden = !problem;
}

// Shows the progress of a request. `which` is a prefix with the number of the photo if there are
// several photos.
function showExportProgress(progress, which = "") {
  byId("export-status").textContent = which + progressText(progress);
  setBar(byId("export-progress"), fraction(progress));
}

const downloadLayer = (signal) =>
  exportLayer(queue.current, chosen("view"), exportSettings(), {
    signal,
    onProgress: (progress) => showExportProgress(progress),
  });

const zipLayers = () =>
  [...document.querySelectorAll("input[name=zip]:checked")].map(({ value }) => value);

// Waits until all photos are separated, and creates the zip.
async function downloadAll(signal) {
  while (queue.pendingCount) {
    signal.throwIfAborted();
    const count = queue.pendingCount;
    const total = queue.photos.length;
    byId("export-status").textContent = byId("burst").hidden
      ? `Waiting for ${count} of ${total} photos`
      : "Waiting for your answer: are these photos of one window?";
    setBar(byId("export-progress"), 1 - count / total);
    await new Promise((resolve) => setTimeout(resolve, WAIT_MS));
  }
  let which = "";
  const onPhoto = (index, count) => (which = count > 1 ? `Photo ${index + 1} of ${count}: ` : "");
  const onProgress = (progress) => showExportProgress(progress, which);
  return exportAll([...queue.photos], zipLayers(), exportSettings(), {
    signal,
    onPhoto,
    onProgress,
  });
}

// --- event handlers

byId("choose").addEventListener("click", () => byId("files").click());
byId("forget").addEventListener("click", forget);
byId("add").addEventListener("click", () => byId("files").click());
byId("choose-folder").addEventListener("click", () => byId("folder").click());
byId("example").addEventListener("click", addExample);
for (const id of ["film", "film-next"])
  byId(id).addEventListener("click", () => byId("camera").click());
for (const id of ["files", "folder", "camera"]) {
  byId(id).addEventListener("change", () => {
    add(readList(byId(id).files, isImage, room(), id === "folder"));
    byId(id).value = "";
  });
}
byId("strength").addEventListener("input", () => {
  queue.current.edits.adjust({ strength: Number(byId("strength").value) });
  onEdit();
});
byId("strength").addEventListener("change", () => queue.current.edits.settle());
byId("copy").addEventListener("click", (event) => {
  if (!isEnabled(event.currentTarget)) return;
  const { strength, list } = queue.current.edits;
  for (const photo of queue.photos) {
    if (photo === queue.current) continue;
    photo.edits.change({ strength, list });
    onEdit(photo);
  }
  refresh();
  announce("The settings were copied to all photos.");
});
byId("reset").addEventListener("click", () => edit({ strength: 1, list: [] }));
byId("swap").addEventListener("click", () => edit({ swap: !queue.current.edits.now.swap }));
byId("measured").addEventListener("click", () =>
  edit({ method: queue.current.edits.now.method === "motion" ? "auto" : "motion" }),
);
byId("name-transmission").addEventListener("click", () => answerNaming(false));
byId("name-reflection").addEventListener("click", () => answerNaming(true));

function answerNaming(swap) {
  edit({ swap });
  compare.focus();
}

for (const input of document.querySelectorAll("input[name=mode]")) {
  input.addEventListener("change", () => (compare.mode = chosen("mode")));
}
byId("before").addEventListener("click", toggleBefore);
document.addEventListener("keydown", (event) => {
  const isShortcut =
    event.key.toLowerCase() === "b" && !event.ctrlKey && !event.metaKey && !event.altKey;
  if (isShortcut && shown && !event.target.closest("select")) toggleBefore();
});
for (const input of document.querySelectorAll("input[name=view]"))
  input.addEventListener("change", paint);
for (const input of document.querySelectorAll("input[name=quality], #model"))
  input.addEventListener("change", applySettings);
byId("cancel").addEventListener("click", () => queue.cancel(queue.current));
byId("retry").addEventListener("click", () => queue.retry(queue.current));
byId("retry-all").addEventListener("click", () => {
  for (const photo of queue.retriable) queue.retry(photo);
});
byId("discard").addEventListener("click", () => remove(queue.current));
byId("undo-remove").addEventListener("click", undoRemove);
byId("burst-yes").addEventListener("click", joinBurst);
byId("burst-no").addEventListener("click", release);
byId("split").addEventListener("click", splitBurst);
for (const input of document.querySelectorAll("input[name=zip]"))
  input.addEventListener("change", () => refresh());
byId("download").addEventListener("click", (event) =>
  runExport(event.currentTarget, downloadLayer),
);
byId("all").addEventListener("click", (event) => runExport(event.currentTarget, downloadAll));
byId("stop-export").addEventListener("click", () => exporting?.abort());
byId("panel").addEventListener("submit", (event) => event.preventDefault());

// Switches between the photo and the comparison.
function toggleBefore() {
  compare.isBefore = !compare.isBefore;
  byId("before").setAttribute("aria-pressed", compare.isBefore);
}

watchTransfers(async (transfer) => {
  try {
    add(await readTransfer(transfer, isImage, room()));
  } catch (error) {
    announce(`The dropped files cannot be read (${error.message}).`);
    showNote(byId("announcement").textContent);
    refresh();
  }
});

// Asks before the page is left with photos that this browser does not keep, if they have results
// that were not downloaded.
window.addEventListener("beforeunload", (event) => {
  const isAtRisk = ({ state, isSaved, isKept }) =>
    !isKept && ((state === "done" && !isSaved) || state === "working" || state === "waiting");
  if (queue.photos.some(isAtRisk)) event.preventDefault();
});

watchScrolling();
paint();
loadModels();
