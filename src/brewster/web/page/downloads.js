// The download buttons: one layer of the current photo, or all photos as a zip, with their
// progress.

import { sleep } from "./api.js";
import { announce, byId, checkedValues, chosen, isEnabled, setBar } from "./dom.js";
import { exportAll, exportLayer, save } from "./export.js";
import { fraction, progressText, WAITING_FOR_ANSWER } from "./status.js";
import { isNamingOpen } from "./verdict.js";

const WAIT_MS = 200; // how often a zip checks whether all photos are separated

export class Downloads {
  #running = null; // the AbortController of the running download

  // `settings()` returns the settings of a request, and `onChange()` is called when a download
  // starts or ends.
  constructor(queue, list, { settings, onChange }) {
    Object.assign(this, { queue, list, settings, onChange });
    byId("download").addEventListener("click", (event) => {
      this.#run(event.currentTarget, (signal) => this.#downloadLayer(signal));
    });
    byId("all").addEventListener("click", (event) => {
      this.#run(event.currentTarget, (signal) => this.#downloadAll(signal));
    });
    byId("stop-export").addEventListener("click", () => this.#running?.abort());
  }

  get isRunning() {
    return this.#running !== null;
  }

  async #run(button, work) {
    if (!isEnabled(button)) return;
    this.#running = new AbortController();
    byId("export-error").hidden = true;
    byId("export").hidden = false;
    this.onChange();
    try {
      const { name, blob, problem, saved } = await work(this.#running.signal);
      save(name, blob);
      for (const photo of saved) photo.isSaved = true;
      announce(`${name} is ready`);
      showError(problem);
    } catch (error) {
      showError(error.name === "AbortError" ? "" : error.message);
    }
    this.#running = null;
    if (byId("export").contains(document.activeElement)) button.focus();
    byId("export").hidden = true;
    this.onChange();
  }

  #downloadLayer(signal) {
    const onProgress = (progress) => showProgress(progress);
    return exportLayer(this.queue.current, chosen("view"), this.settings(), { signal, onProgress });
  }

  // Returns a photo whose layers the user has not named yet, or undefined.
  #unnamed() {
    return this.queue.photos.find((photo) => photo.state === "done" && isNamingOpen(photo));
  }

  // Waits until all photos are separated and their layers are named, and creates the zip.
  async #downloadAll(signal) {
    const { queue } = this;
    while (queue.pendingCount || this.#unnamed()) {
      this.#showWaiting();
      await sleep(WAIT_MS, signal);
    }
    let which = "";
    return exportAll([...queue.photos], checkedValues("zip"), this.settings(), {
      signal,
      onPhoto(index, count) {
        which = count > 1 ? `Photo ${index + 1} of ${count}: ` : "";
      },
      onProgress: (progress) => showProgress(progress, which),
    });
  }

  #showWaiting() {
    const { photos, pendingCount } = this.queue;
    let text = `Waiting for ${pendingCount} of ${photos.length} photos`;
    if (!pendingCount) {
      const { name } = this.#unnamed().file;
      text = `Waiting for your answer: which layer of ${name} is behind the glass?`;
    }
    byId("export-status").textContent = this.list.isBurstAsked ? WAITING_FOR_ANSWER : text;
    setBar(byId("export-progress"), 1 - pendingCount / photos.length);
  }
}

function showError(problem) {
  byId("export-error").textContent = problem;
  byId("export-error").hidden = !problem;
}

// Shows the progress of a request. `which` is a prefix with the number of the photo if there are
// several photos.
function showProgress(progress, which = "") {
  byId("export-status").textContent = which + progressText(progress);
  setBar(byId("export-progress"), fraction(progress));
}
