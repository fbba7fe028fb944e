// The page: which photos there are, what becomes of each, and the one that is shown.

import "./compare.js";
import { models, nameOf, send } from "./api.js";
import { draw, readMaps } from "./light.js";
import { filesOf, zipped } from "./zip.js";

const AT_ONCE = 2; // one is worked on while the next one travels
const ABOUT = {
  transmission: "What is behind the glass.",
  reflection: "What was mirrored in it.",
  confidence: "White where the separation is sure, black where it is not.",
};
const NOTHING = "data:image/gif;base64,R0lGODlhAQABAAAAACH5BAEKAAEALAAAAAABAAEAAAICTAEAOw=="; // one clear pixel
const LAYERS = "transmission,reflection"; // of the zip

const photos = []; // {file, row, state, share, ahead, error, strength, maps, made, stop, isAskedAgain}
let current = null; // the one that is shown
let shown = null; // its maps
const at = (id) => document.getElementById(id);
const compare = at("compare");

// --- what was chosen

const chosen = (name) => document.querySelector(`input[name=${name}]:checked`).value;
const settings = () => ({ quality: chosen("quality"), model: at("model").value });
const isFresh = (photo) => photo.made === JSON.stringify(settings());

// --- photos come and go

function add(files) {
  for (const file of files) {
    const photo = { file, state: "waiting", share: 0, ahead: 0, strength: 1 };
    photo.row = newRow(photo);
    photos.push(photo);
  }
  if (!files.length) return;
  at("news").textContent = files.length === 1 ? `${files[0].name} was added` : `${files.length} photos were added`;
  const isFirst = current === null;
  if (isFirst) select(photos[0]);
  if (isFirst) current.row.querySelector("button").focus();
  refresh();
  next();
}

function remove(photo) {
  photo.stop?.abort();
  const index = photos.indexOf(photo);
  const hadFocus = photo.row.contains(document.activeElement) || at("stage").contains(document.activeElement);
  photos.splice(index, 1);
  photo.row.remove();
  if (photo === current) select(photos[Math.min(index, photos.length - 1)] ?? null);
  if (hadFocus) (current?.row.querySelector("button") ?? at("choose")).focus();
  at("news").textContent = `${photo.file.name} was removed`;
  refresh();
  next();
}

function newRow(photo) {
  const row = document.createElement("li");
  row.innerHTML = `<button type="button" class="pick"><img alt="" width="56" height="56"><span class="name"></span>
    <span class="state"></span></button><button type="button" class="remove">×</button>`;
  row.querySelector(".name").textContent = photo.file.name;
  row.querySelector(".remove").setAttribute("aria-label", `Remove ${photo.file.name}`);
  row.querySelector(".pick").addEventListener("click", () => select(photo));
  row.querySelector(".remove").addEventListener("click", () => remove(photo));
  sketch(row.querySelector("img"), photo.file);
  at("photos").append(row);
  return row;
}

// Shows a file as the browser itself reads it, or nothing where it cannot.
function sketch(image, file) {
  const url = URL.createObjectURL(file);
  const done = () => URL.revokeObjectURL(url);
  image.onload = done;
  image.onerror = () => (done(), (image.src = NOTHING), (image.onload = null));
  image.src = url;
}

// --- the work, a few at a time, the photo that is shown first

function next() {
  const busy = photos.filter((photo) => photo.stop).length;
  const waiting = photos.filter((photo) => photo.state === "waiting" && !photo.stop);
  if (current && waiting.includes(current)) waiting.unshift(current);
  for (const photo of [...new Set(waiting)].slice(0, AT_ONCE - busy)) separate(photo);
}

async function separate(photo) {
  const asked = settings();
  photo.stop = new AbortController();
  Object.assign(photo, { state: "waiting", share: 0, ahead: 0, error: null, isAskedAgain: false });
  const onProgress = (progress) => (Object.assign(photo, progress), refresh(photo));
  try {
    const response = await send("preview", photo.file, asked, { signal: photo.stop.signal, onProgress });
    photo.maps = await response.blob();
    Object.assign(photo, { state: "done", made: JSON.stringify(asked) });
    news(`${photo.file.name} is separated`);
  } catch (error) {
    const isStopped = error.name === "AbortError";
    const asBefore = isFresh(photo) ? "done" : "waiting"; // the maps that it has may be wanted again
    const state = isStopped && photo.isAskedAgain ? asBefore : "failed";
    Object.assign(photo, { state, error: isStopped ? null : error.message });
    if (photo.error) news(`${photo.file.name} failed`);
  }
  photo.stop = null;
  if (!photos.includes(photo)) return;
  if (photo.state === "done" && !isFresh(photo)) photo.state = "waiting"; // the settings have changed meanwhile
  refresh(photo);
  if (photo === current) await show();
  next();
}

function again(photo) {
  Object.assign(photo, { state: "waiting", error: null });
  refresh(photo);
  next();
}

// The settings have changed, perhaps back to those of the maps that a photo has.
function redo() {
  for (const photo of photos) {
    photo.stop?.abort();
    Object.assign(photo, { state: isFresh(photo) ? "done" : "waiting", error: null, isAskedAgain: true });
  }
  refresh();
  show();
  next();
}

function news(sentence) {
  const done = photos.filter((photo) => photo.state === "done").length;
  at("news").textContent = photos.length > 1 ? `${sentence}, ${done} of ${photos.length} are done` : sentence;
}

// --- the photo that is shown

function select(photo) {
  current = photo;
  shown = null;
  for (const other of photos) other.row.querySelector(".pick").removeAttribute("aria-current");
  if (photo) {
    photo.row.querySelector(".pick").setAttribute("aria-current", "true");
    photo.row.scrollIntoView({ block: "nearest", inline: "nearest" });
    at("strength").value = photo.strength;
    sketch(at("sketch"), photo.file);
    compare.reset();
    paint();
  }
  refresh();
  show();
  next();
}

async function show() {
  const photo = current;
  if (photo?.state !== "done") return;
  const maps = readMaps(await photo.maps.arrayBuffer());
  if (photo !== current) return; // another one was chosen meanwhile
  shown = maps;
  draw(compare.left, maps, "photo");
  refresh();
  paint();
}

let isAsked = false;

function paint() {
  at("amount").textContent = `${Math.round(100 * at("strength").value)} %`;
  at("about").textContent = ABOUT[chosen("view")];
  at("download").textContent = `Download ${chosen("view")}`;
  if (!shown || isAsked) return;
  isAsked = true;
  requestAnimationFrame(() => {
    isAsked = false;
    if (!shown) return;
    draw(compare.right, shown, chosen("view"), current.strength);
    compare.show(current.file.name, chosen("view"));
  });
}

function refresh(photo = null) {
  for (const one of photo ? [photo] : photos) {
    one.row.className = one.state;
    one.row.querySelector(".state").textContent = inShort(one);
  }
  enable("all", making === null && photos.some((one) => one.state === "done"));
  if (photo && photo !== current) return;
  const has = current !== null;
  at("welcome").hidden = has;
  for (const id of ["stage", "strip", "panel", "add"]) at(id).hidden = !has;
  if (!has) return;
  const isReady = current.state === "done" && shown !== null;
  const hadFocus = [at("waiting"), at("trouble")].find((part) => part.contains(document.activeElement));
  compare.hidden = !isReady;
  at("trouble").hidden = current.state !== "failed";
  at("waiting").hidden = isReady || current.state === "failed";
  if (hadFocus?.hidden) (isReady ? compare : at(current.state === "failed" ? "again" : "cancel")).focus();
  enable("download", isReady && making === null);
  at("step").textContent = inWords(current);
  if (current.state === "working") at("bar").value = current.share;
  else at("bar").removeAttribute("value");
  at("what").textContent = current.error ? `${current.file.name} could not be separated` : "Cancelled";
  at("why").textContent = current.error ?? "";
  at("facts").textContent = isReady ? facts(shown) : "";
}

// A button that is disabled in earnest would lose the focus.
function enable(id, isEnabled) {
  at(id).setAttribute("aria-disabled", !isEnabled);
}

function facts({ full, width, height, doubtful }) {
  const size = `${full.join(" × ")} pixels`;
  const preview = full[0] === width ? "." : `, shown at ${width} × ${height}.`;
  return size + preview + (doubtful ? " The model redrew it so freely that the layers may be wrong: look closely." : "");
}

function inShort({ state, share, error }) {
  if (state === "failed") return error ? "failed" : "cancelled";
  return { done: "done", working: `${Math.round(100 * share)} %`, waiting: "waiting" }[state];
}

function inWords({ state, share, ahead }) {
  if (state !== "waiting") return `Separating, ${Math.round(100 * share)} %`;
  return ahead ? `Waiting, ${ahead} before it` : "Waiting";
}

// --- files at full size, as the command line makes them

let making = null;

async function make(button, work) {
  if (button.getAttribute("aria-disabled") === "true") return;
  making = new AbortController();
  at("failed").hidden = true;
  at("making").hidden = false;
  refresh();
  try {
    const { name, blob, trouble = "" } = await work(making.signal);
    save(name, blob);
    at("news").textContent = `${name} is ready`;
    complain(trouble);
  } catch (error) {
    complain(error.name === "AbortError" ? "" : error.message);
  }
  making = null;
  if (at("making").contains(document.activeElement)) button.focus();
  at("making").hidden = true;
  refresh();
}

function complain(trouble) {
  at("failed").textContent = trouble;
  at("failed").hidden = !trouble;
}

const fullSize = (photo, layers, signal, onShare) =>
  send("separate", photo.file, { layers, strength: photo.strength, ...settings() }, {
    signal,
    onProgress: ({ share }) => onShare(share),
  });

async function one(signal) {
  const response = await fullSize(current, chosen("view"), signal, (share) => (at("made").value = share));
  return { name: nameOf(response), blob: await response.blob() };
}

// One that fails is left out and named; if all do, there is nothing to save.
async function all(signal) {
  const files = [];
  const failed = [];
  const done = photos.filter((photo) => photo.state === "done");
  for (const [index, photo] of done.entries()) {
    const onShare = (share) => (at("made").value = (index + share) / done.length);
    onShare(0);
    try {
      const response = await fullSize(photo, LAYERS, signal, onShare);
      files.push(...filesOf(await response.arrayBuffer()));
    } catch (error) {
      if (error.name === "AbortError") throw error;
      failed.push(`${photo.file.name} is not in the zip. ${error.message}`);
    }
  }
  const trouble = failed.join(" ");
  if (!files.length) throw new Error(trouble);
  return { name: "brewster.zip", blob: zipped(files), trouble };
}

function save(name, blob) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60_000);
}

// --- hands

at("choose").addEventListener("click", () => at("files").click());
at("add").addEventListener("click", () => at("files").click());
at("files").addEventListener("change", () => {
  add([...at("files").files]);
  at("files").value = "";
});
at("strength").addEventListener("input", () => {
  current.strength = Number(at("strength").value);
  paint();
});
for (const input of document.querySelectorAll("input[name=view]")) input.addEventListener("change", paint);
for (const input of document.querySelectorAll("input[name=quality], #model")) input.addEventListener("change", redo);
at("cancel").addEventListener("click", () => {
  if (current.stop) current.stop.abort();
  else (current.state = "failed"), refresh(current);
});
at("again").addEventListener("click", () => again(current));
at("drop").addEventListener("click", () => remove(current));
at("download").addEventListener("click", (event) => make(event.currentTarget, one));
at("all").addEventListener("click", (event) => make(event.currentTarget, all));
at("stop").addEventListener("click", () => making?.abort());
at("panel").addEventListener("submit", (event) => event.preventDefault());

document.addEventListener("paste", (event) => add([...event.clipboardData.files]));
document.addEventListener("dragover", (event) => {
  event.preventDefault();
  document.body.classList.add("over");
});
document.addEventListener("dragleave", (event) => {
  if (!event.relatedTarget) document.body.classList.remove("over");
});
document.addEventListener("drop", (event) => {
  event.preventDefault();
  document.body.classList.remove("over");
  add([...event.dataTransfer.files]);
});

paint();
models()
  .then((rows) => at("model").append(...rows.map(({ name }) => new Option(name))))
  .catch((error) => (at("news").textContent = error.message));
