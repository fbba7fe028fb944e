// The page that separates photos: the list of photos, their processing, and the view of the current photo.

import "./compare.js";
import { models, fileNameOf, send } from "./api.js";
import { draw, readMaps } from "./light.js";
import { createZip, readZip } from "./zip.js";

const MAX_CONCURRENT = 2; // one photo is separated while the next one is uploaded
const LAYER_DESCRIPTIONS = {
  transmission: "The scene behind the glass.",
  reflection: "The light that the glass reflects.",
  confidence: "White: the separation is certain. Black: it is uncertain.",
};
const TRANSPARENT_PIXEL = "data:image/gif;base64,R0lGODlhAQABAAAAACH5BAEKAAEALAAAAAABAAEAAAICTAEAOw==";
const ZIP_LAYERS = "transmission,reflection"; // the layers in the zip of all photos

const photos = []; // {file, row, state, share, ahead, error, strength, maps, mapSettings, controller, isSuperseded}
let current = null; // the photo that is shown
let shown = null; // the maps of the current photo
const byId = (id) => document.getElementById(id);
const compare = byId("compare");

// --- settings

const chosen = (name) => document.querySelector(`input[name=${name}]:checked`).value;
const settings = () => ({ quality: chosen("quality"), model: byId("model").value });
// Whether the maps of a photo were computed with the current settings.
const hasCurrentMaps = (photo) => photo.mapSettings === JSON.stringify(settings());

// --- adding and removing photos

function add(files) {
  for (const file of files) {
    const photo = { file, state: "waiting", share: 0, ahead: 0, strength: 1 };
    photo.row = newRow(photo);
    photos.push(photo);
  }
  if (!files.length) return;
  byId("announcement").textContent = files.length === 1 ? `${files[0].name} was added` : `${files.length} photos were added`;
  const isFirst = current === null;
  if (isFirst) select(photos[0]);
  if (isFirst) current.row.querySelector("button").focus();
  refresh();
  startNext();
}

function remove(photo) {
  photo.controller?.abort();
  const index = photos.indexOf(photo);
  const hadFocus = photo.row.contains(document.activeElement) || byId("stage").contains(document.activeElement);
  photos.splice(index, 1);
  photo.row.remove();
  if (photo === current) select(photos[Math.min(index, photos.length - 1)] ?? null);
  if (hadFocus) (current?.row.querySelector("button") ?? byId("choose")).focus();
  byId("announcement").textContent = `${photo.file.name} was removed`;
  refresh();
  startNext();
}

function newRow(photo) {
  const row = document.createElement("li");
  row.innerHTML = `<button type="button" class="pick"><img alt="" width="56" height="56"><span class="name"></span>
    <span class="state"></span></button><button type="button" class="remove">×</button>`;
  row.querySelector(".name").textContent = photo.file.name;
  row.querySelector(".remove").setAttribute("aria-label", `Remove ${photo.file.name}`);
  row.querySelector(".pick").addEventListener("click", () => select(photo));
  row.querySelector(".remove").addEventListener("click", () => remove(photo));
  showFile(row.querySelector("img"), photo.file);
  byId("photos").append(row);
  return row;
}

// Shows a file as the browser decodes it, or a transparent pixel if it cannot.
function showFile(image, file) {
  const url = URL.createObjectURL(file);
  const done = () => URL.revokeObjectURL(url);
  image.onload = done;
  image.onerror = () => (done(), (image.src = TRANSPARENT_PIXEL), (image.onload = null));
  image.src = url;
}

// --- processing: a few photos at a time, the current photo first

function startNext() {
  const busy = photos.filter((photo) => photo.controller).length;
  const waiting = photos.filter((photo) => photo.state === "waiting" && !photo.controller);
  if (current && waiting.includes(current)) waiting.unshift(current);
  for (const photo of [...new Set(waiting)].slice(0, MAX_CONCURRENT - busy)) separate(photo);
}

async function separate(photo) {
  const requestSettings = settings();
  photo.controller = new AbortController();
  Object.assign(photo, { state: "waiting", share: 0, ahead: 0, error: null, isSuperseded: false });
  const onProgress = (progress) => (Object.assign(photo, progress), refresh(photo));
  try {
    const response = await send("preview", photo.file, requestSettings, { signal: photo.controller.signal, onProgress });
    photo.maps = await response.blob();
    Object.assign(photo, { state: "done", mapSettings: JSON.stringify(requestSettings) });
    announce(`${photo.file.name} is separated`);
  } catch (error) {
    const isStopped = error.name === "AbortError";
    const previousState = hasCurrentMaps(photo) ? "done" : "waiting"; // the old maps are valid if the settings were reset
    const state = isStopped && photo.isSuperseded ? previousState : "failed";
    Object.assign(photo, { state, error: isStopped ? null : error.message });
    if (photo.error) announce(`${photo.file.name} failed`);
  }
  photo.controller = null;
  if (!photos.includes(photo)) return;
  if (photo.state === "done" && !hasCurrentMaps(photo)) photo.state = "waiting"; // the settings have changed since the request
  refresh(photo);
  if (photo === current) await show();
  startNext();
}

function retry(photo) {
  Object.assign(photo, { state: "waiting", error: null });
  refresh(photo);
  startNext();
}

// Called after a change of the settings. A photo is processed again unless its maps were computed with the new settings.
function applySettings() {
  for (const photo of photos) {
    photo.controller?.abort();
    Object.assign(photo, { state: hasCurrentMaps(photo) ? "done" : "waiting", error: null, isSuperseded: true });
  }
  refresh();
  show();
  startNext();
}

function announce(message) {
  const done = photos.filter((photo) => photo.state === "done").length;
  byId("announcement").textContent = photos.length > 1 ? `${message}, ${done} of ${photos.length} are done` : message;
}

// --- the current photo

function select(photo) {
  current = photo;
  shown = null;
  for (const other of photos) other.row.querySelector(".pick").removeAttribute("aria-current");
  if (photo) {
    photo.row.querySelector(".pick").setAttribute("aria-current", "true");
    photo.row.scrollIntoView({ block: "nearest", inline: "nearest" });
    byId("strength").value = photo.strength;
    showFile(byId("thumbnail"), photo.file);
    compare.reset();
    paint();
  }
  refresh();
  show();
  startNext();
}

async function show() {
  const photo = current;
  if (photo?.state !== "done") return;
  const maps = readMaps(await photo.maps.arrayBuffer());
  if (photo !== current) return; // another photo was selected in the meantime
  shown = maps;
  draw(compare.left, maps, "photo");
  refresh();
  paint();
}

let isPaintScheduled = false;

function paint() {
  byId("amount").textContent = `${Math.round(100 * byId("strength").value)} %`;
  byId("layer-description").textContent = LAYER_DESCRIPTIONS[chosen("view")];
  byId("download").textContent = `Download ${chosen("view")}`;
  if (!shown || isPaintScheduled) return;
  isPaintScheduled = true;
  requestAnimationFrame(() => {
    isPaintScheduled = false;
    if (!shown) return;
    draw(compare.right, shown, chosen("view"), current.strength);
    compare.show(current.file.name, chosen("view"));
  });
}

function refresh(photo = null) {
  for (const one of photo ? [photo] : photos) {
    one.row.className = one.state;
    one.row.querySelector(".state").textContent = shortStatus(one);
  }
  enable("all", exporting === null && photos.some((one) => one.state === "done"));
  if (photo && photo !== current) return;
  const hasPhoto = current !== null;
  byId("welcome").hidden = hasPhoto;
  for (const id of ["stage", "strip", "panel", "add"]) byId(id).hidden = !hasPhoto;
  if (!hasPhoto) return;
  const isReady = current.state === "done" && shown !== null;
  const focusedPart = [byId("waiting"), byId("error")].find((part) => part.contains(document.activeElement));
  compare.hidden = !isReady;
  byId("error").hidden = current.state !== "failed";
  byId("waiting").hidden = isReady || current.state === "failed";
  if (focusedPart?.hidden) (isReady ? compare : byId(current.state === "failed" ? "retry" : "cancel")).focus();
  enable("download", isReady && exporting === null);
  byId("status").textContent = statusText(current);
  if (current.state === "working") byId("bar").value = current.share;
  else byId("bar").removeAttribute("value");
  byId("error-title").textContent = current.error ? `${current.file.name} could not be separated` : "Cancelled";
  byId("error-text").textContent = current.error ?? "";
  byId("facts").textContent = isReady ? describeMaps(shown) : "";
}

// Uses aria-disabled: a button with the attribute `disabled` would lose the focus.
function enable(id, isEnabled) {
  byId(id).setAttribute("aria-disabled", !isEnabled);
}

const VERDICTS = {
  clear: "A reflection was found and removed.",
  partial: "A reflection was found. Parts of it probably remain.",
  "little found": "Little reflection was found.",
  doubtful: "The layers may be wrong. Check them.",
};

function describeMaps({ full, width, height, verdict }) {
  const size = `${full.join(" × ")} pixels`;
  const preview = full[0] === width ? "." : `, shown at ${width} × ${height}.`;
  return `${size}${preview} ${VERDICTS[verdict]}`;
}

function shortStatus({ state, share, error }) {
  if (state === "failed") return error ? "failed" : "cancelled";
  return { done: "done", working: `${Math.round(100 * share)} %`, waiting: "waiting" }[state];
}

function statusText({ state, share, ahead }) {
  if (state !== "waiting") return `Separating, ${Math.round(100 * share)} %`;
  return ahead ? `Waiting, ${ahead} before this one` : "Waiting";
}

// --- downloads at full size, equal to the files of the command line

let exporting = null;

async function runExport(button, work) {
  if (button.getAttribute("aria-disabled") === "true") return;
  exporting = new AbortController();
  byId("export-error").hidden = true;
  byId("export").hidden = false;
  refresh();
  try {
    const { name, blob, problem = "" } = await work(exporting.signal);
    save(name, blob);
    byId("announcement").textContent = `${name} is ready`;
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

const requestFullSize = (photo, layers, signal, onShare) =>
  send("separate", photo.file, { layers, strength: photo.strength, ...settings() }, {
    signal,
    onProgress: ({ share }) => onShare(share),
  });

async function exportLayer(signal) {
  const response = await requestFullSize(current, chosen("view"), signal, (share) => (byId("export-progress").value = share));
  return { name: fileNameOf(response), blob: await response.blob() };
}

// A photo that fails is left out, and its error is shown. If all photos fail, nothing is saved.
async function exportAll(signal) {
  const files = [];
  const failed = [];
  const done = photos.filter((photo) => photo.state === "done");
  for (const [index, photo] of done.entries()) {
    const onShare = (share) => (byId("export-progress").value = (index + share) / done.length);
    onShare(0);
    try {
      const response = await requestFullSize(photo, ZIP_LAYERS, signal, onShare);
      files.push(...readZip(await response.arrayBuffer()));
    } catch (error) {
      if (error.name === "AbortError") throw error;
      failed.push(`${photo.file.name} is not in the zip. ${error.message}`);
    }
  }
  const problem = failed.join(" ");
  if (!files.length) throw new Error(problem);
  return { name: "brewster.zip", blob: createZip(files), problem };
}

function save(name, blob) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60_000);
}

// --- event handlers

byId("choose").addEventListener("click", () => byId("files").click());
byId("add").addEventListener("click", () => byId("files").click());
byId("files").addEventListener("change", () => {
  add([...byId("files").files]);
  byId("files").value = "";
});
byId("strength").addEventListener("input", () => {
  current.strength = Number(byId("strength").value);
  paint();
});
for (const input of document.querySelectorAll("input[name=view]")) input.addEventListener("change", paint);
for (const input of document.querySelectorAll("input[name=quality], #model")) input.addEventListener("change", applySettings);
byId("cancel").addEventListener("click", () => {
  if (current.controller) current.controller.abort();
  else (current.state = "failed"), refresh(current);
});
byId("retry").addEventListener("click", () => retry(current));
byId("discard").addEventListener("click", () => remove(current));
byId("download").addEventListener("click", (event) => runExport(event.currentTarget, exportLayer));
byId("all").addEventListener("click", (event) => runExport(event.currentTarget, exportAll));
byId("stop-export").addEventListener("click", () => exporting?.abort());
byId("panel").addEventListener("submit", (event) => event.preventDefault());

document.addEventListener("paste", (event) => add([...event.clipboardData.files]));
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
  add([...event.dataTransfer.files]);
});

paint();
models()
  .then((rows) => byId("model").append(...rows.map(({ name }) => new Option(name))))
  .catch((error) => (byId("announcement").textContent = error.message));
