// The static bundle of a study, written by `brewster study export`. There is no server for answers: this module gives the responses
// that the server of a study gives, and the browser stores the answers until the participant downloads them.

class Bundle {
  #token = new URLSearchParams(location.search).get("p") ?? "";
  #loaded = null; // the trials of the participant, once they are loaded

  // Whether this browser has stored the participant's consent.
  get hasConsent() {
    return Boolean(this.#read().consented_on);
  }

  pictureUrl(trial, side) {
    const { trials, practice } = this.#loaded;
    return `pictures/${(trial === "practice" ? practice : trials[trial])[side]}`;
  }

  // The response of the server to a request. Only the last part of the path is used.
  async respond(path, body) {
    this.#loaded ??= await this.#load();
    const stored = this.#read();
    switch (path.split("/").at(-1)) {
      case "invitation":
        return { consent: this.#loaded.consent, trials: this.#loaded.trials.length };
      case "participants":
        this.#write({ ...stored, consented_on: new Date().toISOString().slice(0, 10) });
        return { link: location.href };
      case "answers": {
        const earlier = stored.answers.find(({ trial }) => trial === body.trial);
        if (!earlier) stored.answers.push({ ...body, answered_at: new Date().toISOString() });
        this.#write(stored);
        return { kept: (earlier ?? body).choice, next: this.#next() };
      }
      case "withdrawals":
        if (stored.answers.at(-1)?.trial === body.trial) stored.withdrawn.push(stored.answers.pop());
        this.#write(stored);
    }
    return this.#next();
  }

  // Saves the answers as a file, in the format that `brewster study import` reads.
  download() {
    const text = JSON.stringify({ format: 1, participant: this.#token, ...this.#read() });
    const link = document.createElement("a");
    link.href = URL.createObjectURL(new Blob([text], { type: "application/json" }));
    link.download = `answers-${this.#token.slice(0, 8)}.json`;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 60_000);
  }

  // The first trial without an answer, as the server describes it. Trials are answered in order.
  #next() {
    const { trials, practice } = this.#loaded;
    const count = this.#read().answers.length;
    const next = { trial: count < trials.length ? count : null, trials: trials.length, last: count ? count - 1 : null };
    if (next.trial === null) return next;
    const { width, height } = trials[count];
    return { ...next, width, height, practice: count ? null : practice };
  }

  async #load() {
    const isToken = /^[\w-]{16,64}$/.test(this.#token);
    const response = isToken ? await fetch(`participants/${this.#token}.json`).catch(() => null) : { status: 404 };
    if (response?.ok) return response.json();
    if (response?.status === 404) {
      throw new Error(`The link with ?p=${this.#token} is unknown. Expected the complete link that you received. Check the link, or ask the person who invited you.`);
    }
    throw new Error(`Your list of pairs could not be loaded${response ? ` (status ${response.status})` : ""}. Expected a connection to the web server. Check your connection, and try again.`);
  }

  #read() {
    try {
      return JSON.parse(localStorage.getItem(this.#key)) ?? { answers: [], withdrawn: [] };
    } catch {
      return { answers: [], withdrawn: [] };
    }
  }

  #write(stored) {
    try {
      localStorage.setItem(this.#key, JSON.stringify(stored));
    } catch (error) {
      throw new Error(`This browser could not store your answer (${error.name}). Expected a browser that stores the data of this page. Allow it in the settings of the browser, and load the page again.`);
    }
  }

  get #key() {
    return `brewster-study ${this.#token}`;
  }
}

// Null if a server runs the study.
export const bundle = document.querySelector('meta[name="study-bundle"]') && new Bundle();
