// The page that separates photos: connects the queue, the list, the pictures and the controls.
//
// Whatever changes calls `refresh`, which shows the state of the page with the views of views.js.

import "./compare.js";
import { abilities } from "./api.js";
import { announce, byId, checkedValues, chosen, isEnabled } from "./dom.js";
import { Downloads } from "./downloads.js";
import { readList, readTransfer, watchTransfers } from "./drop.js";
import { changeTogether, Edits, photosOfLastStep, photosOfNextStep } from "./edits.js";
import { save } from "./export.js";
import { reveal, showDecoded, showFile, updateThumbnail, watchScrolling } from "./filmstrip.js";
import { hintsFile, maskFile } from "./marks.js";
import { isImage, PhotoList } from "./photo_list.js";
import { SeparationQueue } from "./queue.js";
import { keepEdits, keepResult, keepSettings, keepShown, readSession } from "./session.js";
import { createTools } from "./tools.js";
import { verdictOf } from "./verdict.js";
import { Viewer } from "./viewer.js";
import { render } from "./views.js";

const RETRY_MODELS_MS = 3000;

const settings = () => ({ quality: chosen("quality"), model: byId("model").value });
const compare = byId("compare");
const queue = new SeparationQueue(settings, { onChange: refresh, onEnd: finish });
const list = new PhotoList(queue, { onSelect: select, onChange: refresh });
const tools = createTools({
  onEdit: () => onEdit(),
  onUndo: undo,
  onRedo: redo,
  onCopyMarks: copyMarks,
  onMarkStart: () => viewer.hideStrokeNote(),
  onMarking: (isMarking) => viewer.setMarking(isMarking),
  onPaint: () => compare.paint(),
  saveMarks,
});
const viewer = new Viewer(compare, tools, queue, { onChange: refresh });
const downloads = new Downloads(queue, list, { settings: exportSettings, onChange: refresh });
compare.editor = tools.editor;

function exportSettings() {
  return { ...settings(), takesHints: queue.hintModels.has(byId("model").value) };
}

// --- the state of the page

// Returns what the views show.
function pageState() {
  const { current, photos, retriable } = queue;
  const isSeparated = current?.state === "done" || current?.isUpdating === true;
  return {
    photos,
    current,
    isReady: isSeparated && viewer.isShowing,
    layer: chosen("view"),
    retriableCount: retriable.length,
    note: list.note,
    isNoteShown: list.isNoteShown,
    canUndoRemoval: list.canUndoRemoval,
    isBurstAsked: list.isBurstAsked,
    isExporting: downloads.isRunning,
    zipLayers: checkedValues("zip"),
    takesFilms: queue.takesFilms,
  };
}

// Shows the state of the page after a change of one photo, or of anything.
function refresh(photo = null) {
  for (const one of photo ? [photo] : queue.photos) if (one.thumbnail) updateThumbnail(one);
  const state = pageState();
  const focusedPart = ["waiting", "error"].find((id) => byId(id).contains(document.activeElement));
  const wasNamingOpen = !byId("naming").hidden;
  render(state);
  if (!state.current) return;
  if (focusedPart && byId(focusedPart).hidden) moveFocus(state);
  if (!wasNamingOpen && !byId("naming").hidden) {
    viewer.drawNaming();
    announce(byId("naming-question").textContent);
  }
}

// Moves the focus from a part that is no longer shown to the part in its place.
function moveFocus({ current, isReady }) {
  if (isReady) compare.focus();
  else if (current.state !== "failed") byId("cancel").focus();
  else byId(current.error?.isFinal ? "discard" : "retry").focus();
}

// --- the current photo

function select(photo) {
  queue.current = photo;
  viewer.close();
  for (const { thumbnail } of queue.photos) {
    thumbnail.querySelector(".pick").removeAttribute("aria-current");
  }
  if (photo) {
    photo.thumbnail.querySelector(".pick").setAttribute("aria-current", "true");
    reveal(photo);
    keepShown(photo);
    byId("strength").value = photo.edits.strength;
    showFile(byId("thumbnail"), photo.file);
    compare.reset();
  }
  refresh();
  viewer.show();
  queue.startNext();
}

// Shows and keeps the result of a separation that has ended.
function finish(photo) {
  if (photo.state === "done") {
    keepResult(photo);
    showDecoded(photo);
    announceResult(`${photo.file.name} is separated: ${verdictOf(photo)}`);
  }
  if (photo.error) announceResult(`${photo.file.name} failed`);
  if (photo === queue.current) viewer.show();
}

function announceResult(message) {
  const { length } = queue.photos;
  announce(length > 1 ? `${message}, ${queue.count("done")} of ${length} are done` : message);
}

// --- edits

// Applies the edits of a photo. Its files must then be downloaded again.
function onEdit(photo = queue.current) {
  photo.isSaved = false;
  keepEdits(photo);
  queue.applyEdits(photo);
  if (photo !== queue.current) return;
  byId("strength").value = photo.edits.strength;
  tools.update();
  if (photo.isUpdating) tools.editor.showHints();
  else tools.editor.fadeHints();
  viewer.paint();
  refresh();
}

function edit(values) {
  queue.current.edits.change(values);
  onEdit();
}

function answerNaming(swap) {
  edit({ swap });
  compare.focus();
}

function retryAll() {
  for (const photo of queue.retriable) queue.retry(photo);
}

function toggleMethod() {
  edit({ method: queue.current.edits.now.method === "motion" ? "auto" : "motion" });
}

function undo() {
  const photos = photosOfLastStep(queue.photos, queue.current);
  for (const { edits } of photos) edits.undo();
  photos.forEach(onEdit);
  if (photos.length > 1) announce(`The copy was undone in ${photos.length - 1} photos.`);
}

function redo() {
  const photos = photosOfNextStep(queue.photos, queue.current);
  for (const { edits } of photos) edits.redo();
  photos.forEach(onEdit);
}

// Changes all photos in one step.
function copyToAll(values) {
  changeTogether(queue.photos, values);
  queue.photos.forEach(onEdit);
  announce(byId("copied-text").textContent);
}

function copyStrength() {
  if (!isEnabled(byId("copy"))) return;
  const { strength } = queue.current.edits;
  copyToAll({ strength });
}

function copyMarks() {
  const { list: marks } = queue.current.edits;
  const others = queue.photos.length - 1;
  const question =
    `Copy the marks of this photo to ${others} other ${others === 1 ? "photo" : "photos"}? ` +
    "They replace the marks there. Undo takes this back in all photos.";
  if (window.confirm(question)) copyToAll({ list: marks });
}

// Saves the marks in the form of the options --mask and --hints of the command line.
async function saveMarks() {
  const { file, edits, size } = queue.current;
  const stem = isImage(file.name) ? file.name.replace(/\.[^.]*$/, "") : file.name;
  const kinds = { mask: maskFile, hints: hintsFile };
  for (const [kind, createFile] of Object.entries(kinds)) {
    const png = await createFile(edits.list, ...size);
    if (png) save(`${stem}.${kind}.png`, png);
  }
}

// --- settings and start

function applySettings() {
  keepSettings(settings());
  queue.applySettings();
  refresh();
  viewer.show();
}

// Repeats the request until the server responds, because no photo can be separated before.
async function fetchAbilities() {
  for (;;) {
    try {
      return await abilities();
    } catch {
      announce("The server does not respond. The page tries again.");
      byId("status").textContent = byId("announcement").textContent;
      await new Promise((resolve) => setTimeout(resolve, RETRY_MODELS_MS));
    }
  }
}

async function start() {
  const { models, takesFilms } = await fetchAbilities();
  for (const { name, seconds } of models) {
    const label = seconds ? `${name}, about ${Math.round(seconds)} s a photo` : name;
    byId("model").append(new Option(label, name));
  }
  byId("model-field").hidden = models.length < 2;
  queue.versions = Object.fromEntries(models.map(({ name, version }) => [name, version]));
  queue.takesFilms = takesFilms;
  if (!takesFilms) byId("files").accept = byId("files").accept.replace("video/*,", "");
  refresh();
  await restore();
  queue.isReady = true;
  queue.startNext();
}

// Shows the photos, results and settings again that this browser kept.
async function restore() {
  const { photos, settings: kept, shownId } = await readSession();
  if (kept && [...byId("model").options].some(({ value }) => value === kept.model)) {
    byId("model").value = kept.model;
    document.querySelector(`input[name=quality][value=${kept.quality}]`).checked = true;
  }
  const added = new Set(queue.photos.map(({ id }) => id)); // while the models were loaded
  const missing = photos.slice(0, list.room).filter(({ id }) => !added.has(id));
  for (const { id, file, burst, film, history, result } of missing) {
    const photo = Object.assign(queue.add(file, burst, film), { id, edits: new Edits(history) });
    photo.isKept = true;
    list.insert(photo);
    if (!result) continue;
    queue.reuse(photo, result);
    showDecoded(photo);
  }
  if (!missing.length) return;
  const lastShown = queue.photos.find(({ id }) => id === shownId) ?? queue.photos[0];
  if (queue.current === null) select(lastShown);
  else refresh();
  announce("The photos of your last visit are here again.");
}

// --- event handlers

function onClick(actions) {
  for (const [id, act] of Object.entries(actions)) byId(id).addEventListener("click", () => act());
}

function onChangeOf(selector, act) {
  for (const input of document.querySelectorAll(selector)) input.addEventListener("change", act);
}

onClick({
  choose: () => byId("files").click(),
  add: () => byId("files").click(),
  "choose-folder": () => byId("folder").click(),
  film: () => byId("camera").click(),
  "film-next": () => byId("camera").click(),
  example: () => list.addExample(),
  forget: () => list.forget(),
  "undo-remove": () => list.undoRemove(),
  "burst-yes": () => list.joinBurst(),
  "burst-no": () => list.release(),
  split: () => list.splitBurst(),
  cancel: () => queue.cancel(queue.current),
  retry: () => queue.retry(queue.current),
  "retry-all": retryAll,
  discard: () => list.remove(queue.current),
  "zoom-out": () => compare.zoomBy(0.5),
  "zoom-in": () => compare.zoomBy(2),
  "zoom-fit": () => compare.zoomBy(0),
  "zoom-full": () => compare.zoomToFull(),
  copy: copyStrength,
  "undo-copy": undo,
  reset: () => edit({ strength: 1 }),
  swap: () => edit({ swap: !queue.current.edits.now.swap }),
  measured: toggleMethod,
  "name-transmission": () => answerNaming(false),
  "name-reflection": () => answerNaming(true),
});

for (const id of ["files", "folder", "camera"]) {
  byId(id).addEventListener("change", () => {
    list.add(readList(byId(id).files, isImage, list.room, id === "folder"));
    byId(id).value = "";
  });
}
byId("strength").addEventListener("input", () => {
  queue.current.edits.adjust({ strength: Number(byId("strength").value) });
  onEdit();
});
byId("strength").addEventListener("change", () => queue.current.edits.settle());
byId("panel").addEventListener("submit", (event) => event.preventDefault());
compare.addEventListener("painted", () => {
  byId("pixel-size").textContent = `${Math.round(100 * compare.pixelSize)} %`;
});
onChangeOf("input[name=mode]", () => viewer.chooseMode());
onChangeOf("input[name=view]", () => {
  viewer.paint();
  refresh();
});
onChangeOf("input[name=zip]", () => refresh());
onChangeOf("input[name=quality], #model", applySettings);

watchTransfers(async (transfer) => {
  try {
    list.add(await readTransfer(transfer, isImage, list.room));
  } catch (error) {
    list.note = `The dropped files cannot be read (${error.message}).`;
    announce(list.note);
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
start();
