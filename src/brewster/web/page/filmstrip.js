// The list of photos below the current photo: a thumbnail for each photo with its state, the summary, and the buttons that scroll the list.

import { isVideo } from "./drop.js";
import { VERDICTS, verdictOf } from "./verdict.js";

const TRANSPARENT_PIXEL = "data:image/gif;base64,R0lGODlhAQABAAAAACH5BAEKAAEALAAAAAABAAEAAAICTAEAOw==";
const TILE_PX = 512; // see tiles.js
const REDUCED_PX = 240;
const byId = (id) => document.getElementById(id);

export const megabytes = (bytes) => (bytes / 1e6).toFixed(bytes < 9.95e6 ? 1 : 0);

// Creates the thumbnail of a photo with its name and state, and inserts it before `next`, or at the end.
export function createThumbnail(photo, { onSelect, onRemove }, next = null) {
  const thumbnail = document.createElement("li");
  thumbnail.innerHTML = `<button type="button" class="pick"><img alt="" width="56" height="56"><span class="name"></span>
    <span class="state"></span></button><button type="button" class="remove"><span aria-hidden="true">×</span></button>`;
  const name = photo.burst ? `${photo.burst.length} × ${photo.file.name}` : photo.file.name;
  thumbnail.querySelector(".name").textContent = name;
  thumbnail.querySelector(".pick").title = name;
  thumbnail.querySelector(".remove").setAttribute("aria-label", `Remove ${photo.file.name}`);
  thumbnail.querySelector(".pick").addEventListener("click", onSelect);
  thumbnail.querySelector(".remove").addEventListener("click", onRemove);
  showFile(thumbnail.querySelector("img"), photo.file);
  byId("photos").insertBefore(thumbnail, next);
  return thumbnail;
}

// Shows an image file or a picture of a film, or a transparent pixel if the browser cannot decode the file.
export async function showFile(image, file) {
  image.file = file;
  const shown = isVideo(file) ? await posterOf(file) : file;
  if (image.file === file) showImage(image, shown); // otherwise, another file is to be shown
}

function showImage(image, file) {
  const url = URL.createObjectURL(file);
  const done = () => URL.revokeObjectURL(url);
  image.onload = done;
  image.onerror = () => (done(), (image.src = TRANSPARENT_PIXEL), (image.onload = null));
  image.src = url;
}

// Shows the photo as decoded by the server, if the browser cannot decode its file, such as HEIC.
export function showDecoded({ thumbnail, key, size }) {
  const image = thumbnail.querySelector("img");
  if (image.src !== TRANSPARENT_PIXEL) return;
  const level = Math.max(0, Math.ceil(Math.log2(Math.max(...size) / TILE_PX)));
  image.onerror = () => ((image.src = TRANSPARENT_PIXEL), (image.onerror = null));
  image.src = `tile/${key}/${level}/0/0`;
}

// Returns whether all photos have one size and show one scene, as far as the browser can decode them.
export async function showOneScene(photos) {
  const images = photos.map(({ thumbnail }) => thumbnail.querySelector("img"));
  await Promise.allSettled(images.map((image) => image.decode()));
  const sizes = images.map((image) => (image.src === TRANSPARENT_PIXEL || !image.naturalWidth ? null : `${image.naturalWidth} ${image.naturalHeight}`));
  if (sizes.includes(null) || new Set(sizes).size > 1) return false;
  const form = new FormData();
  for (const image of images) form.append("photo", await reduced(image), "thumbnail.png");
  const response = await fetch("related", { method: "POST", body: form }).catch(() => null);
  return response?.ok ? (await response.json()).are_related : false; // a server without the extra for bursts returns an error
}

// Returns a small PNG file of an image or a video.
function reduced(image, { width, height } = { width: image.naturalWidth, height: image.naturalHeight }) {
  const canvas = document.createElement("canvas");
  canvas.width = REDUCED_PX;
  canvas.height = Math.max(1, Math.min(4 * REDUCED_PX, Math.round((REDUCED_PX * height) / width)));
  canvas.getContext("2d").drawImage(image, 0, 0, canvas.width, canvas.height);
  return new Promise((resolve) => canvas.toBlob(resolve));
}

// Returns the picture of a film after a tenth of a second, or the film if the browser cannot decode it.
async function posterOf(film) {
  const video = Object.assign(document.createElement("video"), { muted: true, playsInline: true, preload: "auto" });
  const url = URL.createObjectURL(film);
  const poster = new Promise((resolve) => {
    video.onloadedmetadata = () => (video.currentTime = 0.1);
    video.onseeked = () => resolve(reduced(video, { width: video.videoWidth, height: video.videoHeight }));
    video.onerror = () => resolve(film);
  });
  video.src = url;
  return poster.finally(() => URL.revokeObjectURL(url));
}

export function updateThumbnail(photo) {
  photo.thumbnail.className = photo.state;
  photo.thumbnail.querySelector(".state").textContent = shortStatus(photo);
}

function shortStatus(photo) {
  const { state, progress, error } = photo;
  if (state === "failed") return error ? "failed" : "cancelled";
  if (state === "done") return verdictOf(photo);
  if (state !== "working") return state;
  if (progress.phase === "working") return `${Math.round(100 * progress.share)} %`;
  return progress.phase === "upload" ? "sending" : "receiving";
}

// Returns the state of a photo that is not done, in words.
export function statusText({ state, progress }) {
  if (state !== "working") return progress?.ahead ? `Waiting, ${progress.ahead} before this photo` : "Waiting";
  return progressText(progress);
}

export function progressText(progress) {
  if (progress.phase === "waiting") return "Waiting for the server";
  if (progress.phase === "working") return progress.share > 0.99 ? "Finishing" : `Separating, ${Math.floor(100 * progress.share)} %${timeLeft(progress.secondsLeft)}`;
  const verb = progress.phase === "upload" ? "Sending" : "Receiving";
  return `${verb} ${megabytes(progress.loaded)} of ${megabytes(progress.total)} MB`;
}

function timeLeft(seconds) {
  if (seconds === null) return "";
  if (seconds >= 90) return `, about ${Math.round(seconds / 60)} min left`;
  const rounded = seconds < 10 ? Math.ceil(seconds) : 5 * Math.round(seconds / 5);
  return `, about ${rounded} s left`;
}

// Returns the completed fraction of a phase, or null if it is unknown.
export function fraction(progress) {
  if (!progress || progress.phase === "waiting") return null;
  return progress.phase === "working" ? progress.share : progress.total ? progress.loaded / progress.total : null;
}

// Sets the value of a <progress>. null shows a bar without a value.
export function setBar(bar, value) {
  if (value === null) bar.removeAttribute("value");
  else bar.value = value;
}

// Returns a summary such as "12 photos: 8 partly removed, 4 failed".
export function summarise(queue) {
  const total = queue.photos.length;
  const names = queue.photos.map((photo) => (photo.state === "done" ? verdictOf(photo) : photo.state));
  const order = [...VERDICTS, "working", "waiting", "failed"];
  const parts = order.map((name) => [names.filter((one) => one === name).length, name]).filter(([count]) => count).map((part) => part.join(" "));
  return `${total} ${total === 1 ? "photo" : "photos"}: ${parts.join(", ")}`;
}

// Shows the scroll buttons while the list is wider than the window.
export function watchScrolling() {
  const list = byId("photos");
  const update = () => {
    const end = list.scrollWidth - list.clientWidth;
    for (const id of ["earlier", "later"]) byId(id).hidden = end <= 1;
    byId("earlier").setAttribute("aria-disabled", list.scrollLeft <= 1);
    byId("later").setAttribute("aria-disabled", list.scrollLeft >= end - 1);
  };
  for (const [id, direction] of [["earlier", -1], ["later", 1]]) {
    byId(id).addEventListener("click", () => list.scrollBy({ left: direction * 0.8 * list.clientWidth, behavior: "smooth" }));
  }
  list.addEventListener("scroll", update);
  new ResizeObserver(update).observe(list);
  new MutationObserver(update).observe(list, { childList: true });
}
