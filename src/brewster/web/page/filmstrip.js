// The list of photos below the current photo: a thumbnail for each photo with its state, the
// summary, and the buttons that scroll the list.

import { byId } from "./dom.js";
import { isVideo } from "./drop.js";
import { draw, Layers, readPreview } from "./light.js";
import { shortStatus } from "./status.js";

const TRANSPARENT_PIXEL =
  "data:image/gif;base64,R0lGODlhAQABAAAAACH5BAEKAAEALAAAAAABAAEAAAICTAEAOw==";
const REDUCED_PX = 240;
const MAX_NAME_LETTERS = 22; // two lines

// Creates the thumbnail of a photo with its name and state, and inserts it before `next`, or at the
// end.
export function createThumbnail(photo, { onSelect, onRemove }, next = null) {
  const thumbnail = document.createElement("li");
  thumbnail.innerHTML = `<button type="button" class="pick"><img alt="" width="56" height="56">
    <span class="name"></span> <span class="state"></span></button>
    <button type="button" class="remove"><span aria-hidden="true">×</span></button>`;
  const name = photo.burst ? `${photo.burst.length} × ${photo.file.name}` : photo.file.name;
  thumbnail.querySelector(".name").textContent = shortened(name);
  thumbnail.querySelector(".pick").title = name;
  thumbnail.querySelector(".remove").setAttribute("aria-label", `Remove ${photo.file.name}`);
  thumbnail.querySelector(".pick").addEventListener("click", onSelect);
  thumbnail.querySelector(".remove").addEventListener("click", onRemove);
  photo.isShown = showFile(thumbnail.querySelector("img"), photo.file);
  byId("photos").insertBefore(thumbnail, next);
  return thumbnail;
}

// Returns a long name without its middle, because names of photos differ at their end.
function shortened(name) {
  const letters = [...name];
  return letters.length > MAX_NAME_LETTERS
    ? `${letters.slice(0, 9).join("")}…${letters.slice(10 - MAX_NAME_LETTERS).join("")}`
    : name;
}

// Shows an image file or a picture of a film. Returns whether the browser can decode the file; if
// not, a transparent pixel is shown.
export async function showFile(image, file) {
  image.file = file;
  const shown = isVideo(file) ? await posterOf(file) : file;
  return image.file === file && showImage(image, shown); // otherwise, another file is to be shown
}

function showImage(image, file) {
  const url = URL.createObjectURL(file);
  const isShown = new Promise((resolve) => {
    image.onload = () => resolve(true);
    image.onerror = () => {
      resolve(false);
      image.src = TRANSPARENT_PIXEL;
    };
  });
  image.src = url;
  return isShown.finally(() => URL.revokeObjectURL(url));
}

// Shows the photo as decoded by the server, if the browser cannot decode its file, such as HEIC.
export async function showDecoded({ thumbnail, preview, isShown }) {
  if (await isShown) return;
  const canvas = document.createElement("canvas");
  draw(canvas, Layers.ofPreview(await readPreview(preview)), "photo");
  showImage(thumbnail.querySelector("img"), await reduced(canvas, canvas));
}

// Returns whether all photos have one size and show one scene, as far as the browser can decode
// them.
export async function showOneScene(photos) {
  const images = photos.map(({ thumbnail }) => thumbnail.querySelector("img"));
  const areShown = await Promise.all(photos.map(({ isShown }) => isShown));
  const sizes = images.map(({ naturalWidth, naturalHeight }) => `${naturalWidth} ${naturalHeight}`);
  if (areShown.includes(false) || new Set(sizes).size > 1) return false;
  const form = new FormData();
  for (const image of images) form.append("photo", await reduced(image), "thumbnail.png");
  const response = await fetch("related", { method: "POST", body: form }).catch(() => null);
  // a server without the extra for bursts returns an error
  return response?.ok ? (await response.json()).are_related : false;
}

// Returns a small PNG file of an image or a video.
function reduced(
  image,
  { width, height } = { width: image.naturalWidth, height: image.naturalHeight },
) {
  const canvas = document.createElement("canvas");
  canvas.width = REDUCED_PX;
  canvas.height = Math.max(1, Math.min(4 * REDUCED_PX, Math.round((REDUCED_PX * height) / width)));
  canvas.getContext("2d").drawImage(image, 0, 0, canvas.width, canvas.height);
  return new Promise((resolve) => canvas.toBlob(resolve));
}

// Returns the picture of a film after a tenth of a second, or the film if the browser cannot decode
// it.
async function posterOf(film) {
  const video = Object.assign(document.createElement("video"), {
    muted: true,
    playsInline: true,
    preload: "auto",
  });
  const url = URL.createObjectURL(film);
  const poster = new Promise((resolve) => {
    video.onloadedmetadata = () => (video.currentTime = 0.1);
    video.onseeked = () =>
      resolve(reduced(video, { width: video.videoWidth, height: video.videoHeight }));
    video.onerror = () => resolve(film);
  });
  video.src = url;
  return poster.finally(() => URL.revokeObjectURL(url));
}

// Scrolls the list, and not the page, until the thumbnail of a photo is visible.
export function reveal({ thumbnail }) {
  const list = byId("photos");
  const shown = list.getBoundingClientRect();
  const { left, right } = thumbnail.getBoundingClientRect();
  if (left < shown.left) list.scrollLeft += left - shown.left;
  else if (right > shown.right) list.scrollLeft += right - shown.right;
}

export function updateThumbnail(photo) {
  photo.thumbnail.className = photo.state;
  photo.thumbnail.querySelector(".state").textContent = shortStatus(photo);
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
  for (const [id, direction] of [
    ["earlier", -1],
    ["later", 1],
  ]) {
    byId(id).addEventListener("click", () =>
      list.scrollBy({ left: direction * 0.8 * list.clientWidth, behavior: "smooth" }),
    );
  }
  list.addEventListener("scroll", update);
  new ResizeObserver(update).observe(list);
  new MutationObserver(update).observe(list, { childList: true });
}
