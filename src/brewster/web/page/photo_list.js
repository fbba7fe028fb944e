// The list of photos: adding and removing them, joining several photos to a burst, and the note
// above the list.

import { announce, byId } from "./dom.js";
import { describeAdded, MAX_PHOTOS, readList } from "./drop.js";
import { createThumbnail, showOneScene } from "./filmstrip.js";
import { forgetAll, forgetPhoto, keepPhoto } from "./session.js";

// The film is better than any photo, but not all servers take films.
const EXAMPLE_FILM = "page/example.mp4";
const EXAMPLE_PHOTO = "page/example.jpg";
const MAX_BURST_PHOTOS = 15;

const suffixes = byId("files")
  .accept.split(",")
  .filter((part) => part.startsWith("."));

export const isImage = (name) => suffixes.some((suffix) => name.toLowerCase().endsWith(suffix));

export class PhotoList {
  note = ""; // the note above the list
  isBurstAsked = false; // whether the user is asked if the candidates are a burst
  #removed = null; // {photo, index} of the photo that was removed last
  #candidates = []; // the photos that may be a burst: they are held until it is known

  // `onSelect(photo)` is called to show a photo, or none (null), and `onChange()` after other
  // changes.
  constructor(queue, { onSelect, onChange }) {
    Object.assign(this, { queue, onSelect, onChange });
  }

  // The number of photos that can be added.
  get room() {
    return Math.max(0, MAX_PHOTOS - this.queue.photos.length);
  }

  get canUndoRemoval() {
    return this.#removed !== null;
  }

  // While the photo that was removed last can be restored, the note has a button for this.
  get isNoteShown() {
    return this.note !== "" || this.canUndoRemoval;
  }

  // Adds the files of a result of drop.js.
  add(found) {
    const { queue } = this;
    const filmOf = (file) => (queue.takesFilms ? (found.films.get(file) ?? null) : null);
    const photos = found.files.map((file) => queue.add(file, null, filmOf(file)));
    const isFirst = queue.current === null;
    for (const photo of photos) this.insert(photo);
    if (!found.files.length && !found.others && !found.surplus) return;
    this.#askForBurst(photos);
    announce(describeAdded(found));
    if (found.others || found.surplus) this.note = describeAdded(found);
    if (!photos.length) return this.onChange();
    this.onSelect(photos[0]);
    // A ring around another photo than the one that is shown would look like a selection
    if (isFirst || byId("photos").contains(document.activeElement)) focusOn(photos[0]);
  }

  async addExample() {
    try {
      const response = await fetch(this.queue.takesFilms ? EXAMPLE_FILM : EXAMPLE_PHOTO);
      const blob = await response.blob();
      const name = response.url.split("/").at(-1);
      const file = new File([blob], name, { type: blob.type });
      this.add(readList([file], isImage, this.room, false));
    } catch {
      announce("The server does not respond. Start it again if it was stopped, then try again.");
    }
  }

  // Inserts a photo of the queue before another one, or at the end.
  insert(photo, next = null) {
    const actions = { onSelect: () => this.onSelect(photo), onRemove: () => this.remove(photo) };
    photo.thumbnail = createThumbnail(photo, actions, next);
    if (!photo.isKept) keepPhoto(photo);
  }

  remove(photo) {
    const { queue } = this;
    const hadFocus = [photo.thumbnail, byId("stage")].some((part) =>
      part.contains(document.activeElement),
    );
    const index = queue.remove(photo);
    forgetPhoto(photo);
    photo.isKept = false;
    if (this.#candidates.includes(photo)) this.release();
    this.#removed = { photo, index };
    photo.thumbnail.remove();
    this.note = `${photo.file.name} was removed.`;
    const next = queue.photos[Math.min(index, queue.photos.length - 1)] ?? null;
    if (photo === queue.current) this.onSelect(next);
    this.onChange();
    if (hadFocus && queue.current) focusOn(queue.current);
    else if (hadFocus) byId("undo-remove").focus();
    announce(`${photo.file.name} was removed`);
    queue.startNext();
  }

  undoRemove() {
    const { photo, index } = this.#removed;
    this.#removed = null;
    this.queue.restore(photo, index);
    this.insert(photo, this.queue.photos[index + 1]?.thumbnail ?? null);
    this.note = "";
    this.onSelect(photo);
    focusOn(photo);
    announce(`${photo.file.name} was added again`);
  }

  // Removes all photos, also from this browser.
  async forget() {
    if (!window.confirm("Forget all photos, marks and settings of this page?")) return;
    for (const photo of [...this.queue.photos]) {
      this.queue.remove(photo);
      photo.thumbnail.remove();
    }
    await forgetAll();
    this.#removed = null;
    this.note = "";
    this.release();
    this.onSelect(null);
    announce("All photos, marks and settings are forgotten.");
    byId("choose").focus();
  }

  // Asks whether several photos are a burst, if they show one scene. None of them is separated
  // before the answer.
  async #askForBurst(photos) {
    if (photos.length < 2 || photos.length > MAX_BURST_PHOTOS) return;
    if (photos.some(({ isBurst, film }) => isBurst || film)) return;
    for (const photo of photos) photo.isHeld = true;
    this.release(); // the answer to a question that is still open is no
    this.#candidates = photos;
    const isOneScene = await showOneScene(photos);
    if (this.#candidates !== photos) return;
    if (!isOneScene) return this.release();
    this.isBurstAsked = true;
    this.onChange();
    announce(byId("burst-question").textContent);
  }

  // Separates the held photos one by one.
  release() {
    for (const photo of this.#candidates) photo.isHeld = false;
    this.#candidates = [];
    this.isBurstAsked = false;
    this.onChange();
    this.queue.startNext();
  }

  joinBurst() {
    const photos = this.#candidates;
    const files = photos.map(({ file }) => file);
    const middle = files[files.length >> 1]; // the reference photo of the server
    this.#replace(photos, [this.queue.add(middle, files)]);
    this.release();
  }

  splitBurst() {
    const { current } = this.queue;
    this.#replace(
      [current],
      current.burst.map((file) => this.queue.add(file)),
    );
  }

  // Replaces photos in the list by others, and selects the first of these.
  #replace(old, added) {
    for (const photo of old) {
      this.queue.remove(photo);
      forgetPhoto(photo);
      photo.thumbnail.remove();
    }
    for (const photo of added) this.insert(photo);
    this.onSelect(added[0]);
    focusOn(added[0]);
  }
}

const focusOn = ({ thumbnail }) => thumbnail.querySelector("button").focus({ preventScroll: true });
