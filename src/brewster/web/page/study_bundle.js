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
        return { consent: this.#loaded.consent, trials: this.#loaded.trials.length, is_open: true };
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
    const unknown = "This link is unknown. Check that it is complete, or ask the person who invited you.";
    if (!/^[\w-]{16,64}$/.test(this.#token)) throw new Error(unknown);
    const response = await fetch(`participants/${this.#token}.json`);
    if (!response.ok) throw new Error(unknown);
    return response.json();
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
    } catch {
      throw new Error("This browser cannot store your answers. Allow this page to store data, and load it again.");
    }
  }

  get #key() {
    return `brewster-study ${this.#token}`;
  }
}

// Null if a server runs the study.
export const bundle = document.querySelector('meta[name="study-bundle"]') && new Bundle();
