// The photos of the page and their separation. The current photo is separated first.

import { send } from "./api.js";
import { isVideo } from "./drop.js";
import { Edits } from "./edits.js";
import { readHead } from "./light.js";
import { hintsFile, isHint } from "./marks.js";

const MAX_CONCURRENT = 2; // one photo is separated while the next photo is uploaded

const NO_FILMS =
  "The server of this page separates photos only. For films, install the extra burst of brewster " +
  "on the computer that runs it, and start the server again.";

export class SeparationQueue {
  photos = [];
  current = null; // the photo that is shown
  isReady = false; // whether the settings are known; no separation starts before that
  hintModels = new Set(); // the names of the models that take hints, as far as they are known
  versions = {}; // of the models, by name
  takesFilms = true; // whether the server separates films and bursts

  // `settings()` returns the settings of the next request. `onChange(photo)` is called after each
  // change of a photo, and `onEnd(photo)` when its separation has ended.
  constructor(settings, { onChange, onEnd }) {
    Object.assign(this, { settings, onChange, onEnd });
  }

  // Adds a photo, or a film. `burst` are the files of all photos of one window, if `file` is the
  // middle one of a burst, and `film` is the file with the film that a phone recorded around the
  // photo. A photo is not separated while its `isHeld` is true. `upload` is the key of its files on
  // the server.
  add(file, burst = null, film = null) {
    const isBurst = burst !== null || isVideo(file);
    const photo = {
      file,
      burst,
      film,
      isBurst,
      state: "waiting",
      progress: null,
      error: null,
      edits: new Edits(),
      controller: null,
      upload: null,
      isSaved: false,
    };
    this.photos.push(photo);
    return photo;
  }

  // Removes a photo and stops its separation. Returns its index.
  remove(photo) {
    const index = this.photos.indexOf(photo);
    this.photos.splice(index, 1);
    this.#supersede(photo);
    return index;
  }

  // Puts a removed photo back.
  restore(photo, index) {
    this.photos.splice(index, 0, photo);
    if (photo.state !== "failed") photo.state = this.hasCurrentMaps(photo) ? "done" : "waiting";
  }

  // Gives a photo the result of an earlier visit, and separates it again only if that was made with
  // other settings.
  reuse(photo, kept) {
    Object.assign(photo, kept);
    if (kept.takesHints) this.hintModels.add(kept.model);
    if (this.hasCurrentMaps(photo)) photo.state = "done";
  }

  // Whether the maps of a photo were computed with the current settings and hints.
  hasCurrentMaps(photo) {
    return photo.mapSettings === this.#mapSettings(photo);
  }

  takesHints(photo) {
    return (
      photo.size !== undefined && !isMeasured(photo) && this.hintModels.has(this.settings().model)
    );
  }

  // Separates a photo again after a change of its hints, its method or the order of its layers. The
  // old result is shown until then. The first separation of a photo compares them at its end.
  applyEdits(photo) {
    if (this.hasCurrentMaps(photo) || (photo.state !== "done" && !photo.isUpdating)) return;
    this.#supersede(photo);
    Object.assign(photo, { state: "waiting", isUpdating: true });
    this.startNext();
  }

  #mapSettings(photo) {
    const { list, method, swap } = photo.edits.now;
    const hints = this.takesHints(photo) && list.some(isHint) ? list : [];
    const settings = this.settings();
    return JSON.stringify([settings, this.versions[settings.model], hints, method, swap === true]);
  }

  // Call this after a change of the settings. A photo is separated again unless its maps were
  // computed with the new settings.
  applySettings() {
    for (const photo of this.photos) {
      this.#supersede(photo);
      Object.assign(photo, {
        state: this.hasCurrentMaps(photo) ? "done" : "waiting",
        error: null,
        isSaved: false,
      });
    }
    this.startNext();
  }

  retry(photo) {
    Object.assign(photo, { state: "waiting", error: null });
    this.onChange(photo);
    this.startNext();
  }

  // The photos that may succeed if they are sent again, for example because the server was away.
  get retriable() {
    return this.photos.filter(({ state, error }) => state === "failed" && error && !error.isFinal);
  }

  get pendingCount() {
    return this.count("waiting") + this.count("working");
  }

  cancel(photo) {
    if (photo.controller) photo.controller.abort();
    else Object.assign(photo, { state: "failed", isUpdating: false });
    this.onChange(photo);
  }

  count(state) {
    return this.photos.filter((photo) => photo.state === state).length;
  }

  startNext() {
    if (!this.isReady) return;
    const busy = this.photos.filter((photo) => photo.controller).length;
    const waiting = this.photos.filter(
      (photo) => photo.state === "waiting" && !photo.controller && !photo.isHeld,
    );
    if (waiting.includes(this.current)) waiting.unshift(this.current);
    for (const photo of [...new Set(waiting)].slice(0, Math.max(0, MAX_CONCURRENT - busy)))
      this.#separate(photo);
  }

  #supersede(photo) {
    photo.isSuperseded = true;
    photo.controller?.abort();
  }

  async #separate(photo) {
    const requestSettings = this.settings();
    const mapSettings = this.#mapSettings(photo);
    const controller = new AbortController();
    const { signal } = controller;
    Object.assign(photo, {
      controller,
      state: "waiting",
      progress: null,
      error: null,
      isSuperseded: false,
    });
    const onProgress = (progress) => {
      Object.assign(photo, {
        progress,
        state: progress.phase === "waiting" ? "waiting" : "working",
      });
      this.onChange(photo);
    };
    try {
      if (photo.isBurst && !this.takesFilms)
        throw Object.assign(new Error(NO_FILMS), { isFinal: true });
      const hints = this.takesHints(photo)
        ? await hintsFile(photo.edits.list, ...photo.size)
        : null;
      const options = { ...requestSettings, ...burstOptions(photo), hints };
      const { blob } = await send("preview", photo, options, { signal, onProgress });
      // the result with the names of `brewster --json`
      const { result, size, takes_hints: takesHints } = await readHead(blob);
      Object.assign(photo, { preview: blob, model: requestSettings.model, result, size });
      photo.takesHints = takesHints;
      if (takesHints) this.hintModels.add(photo.model);
      Object.assign(photo, { state: "done", mapSettings, isSaved: false });
    } catch (error) {
      const isStopped = error.name === "AbortError";
      // the old maps are valid if the settings were changed back
      const previousState = this.hasCurrentMaps(photo) ? "done" : "waiting";
      const state = isStopped && photo.isSuperseded ? previousState : "failed";
      Object.assign(photo, { state, error: isStopped ? null : error });
    }
    photo.controller = null;
    photo.isUpdating &&= photo.state === "waiting";
    if (!this.photos.includes(photo)) return;
    // the settings have changed since the request
    if (photo.state === "done" && !this.hasCurrentMaps(photo)) photo.state = "waiting";
    this.onChange(photo);
    this.onEnd(photo);
    this.startNext();
  }
}

// Whether the layers of a photo were measured by the motion in a burst or in its own film.
export const isMeasured = ({ isBurst, result }) => isBurst || methodOf(result) === "burst";

// Returns how a result was separated, see `BurstReport.method`, or null for a photo alone.
export const methodOf = (result) => result?.burst?.method ?? null;

// Returns the options of a burst, or of a photo with a film, for a request. They are empty for a
// single photo.
export function burstOptions({ isBurst, film, result, edits }) {
  const { method, swap } = edits.now;
  const hasFilm = film || result?.burst?.film;
  return isBurst || hasFilm ? { method, swap: swap ? "yes" : "no" } : {};
}
