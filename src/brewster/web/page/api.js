// The client of the HTTP API. A failed request throws an Error whose message can be shown to the
// user; `details` is the message of the server, and `isFinal` whether the same request would fail
// again.

import { isVideo } from "./drop.js";

const POLL_MS = 300;
const STILL_MS = 4000; // without progress for so long, an estimate of the time would be wrong
const MIN_SHARE = 0.2; // the completed fraction from which the time left is estimated
// maximum number of repetitions of a request while the queue of the server is full
const MAX_RETRIES = 60;
// maximum number of uploads for one request, if the server drops the photo each time
const MAX_UPLOADS = 3;

const STALE_LINK =
  "The link of this page is an old one: the server was started with another one. On the computer " +
  "that runs brewster, scan the QR code again, or open the link that it printed. Your photos " +
  "stay here.";

// The explanation of an error of the server, by its kind. The message of the server is shown below
// the explanation.
const MEANINGS = {
  UnreadablePhoto: "This file is not a photo, or it is damaged.",
  UnreadableVideo: "This video cannot be read: it is damaged, has no picture, or has only one.",
  UnsupportedPhoto: "This kind of image cannot be separated.",
  PhotoTooLarge: "This photo has more pixels than the server accepts.",
  MissingExtra: "The server cannot do this, because a part of brewster is not installed.",
};

// Sends options for a photo of the queue to a path. The files of the photo are sent once: the
// server keeps them, and `photo.upload` is their key. If it has dropped them, they are sent again.
// Returns {blob, fileName}. Before it returns, it calls `onProgress` repeatedly with {phase:
// "upload" | "download", loaded, total} in bytes, {phase: "waiting", ahead} or {phase: "working",
// share, preparing, secondsLeft}, where `ahead` is the number of photos before this photo, `share`
// is the completed fraction, `preparing` that of what the first film waits for, or null, and
// `secondsLeft` is null at the beginning.
export async function send(path, photo, options, context) {
  const form = new FormData();
  for (const [name, value] of Object.entries(options)) {
    if (value instanceof Blob) form.append(name, value, `${name}.png`);
    else if (value !== null) form.append(name, value);
  }
  for (let uploads = 1; ; uploads++) {
    form.set("photo", photo.upload ?? (await upload(photo, context)));
    try {
      return await request(path, form, photo.file, { ...context, job: randomJobName() });
    } catch (error) {
      if (error.status !== 404 || uploads === MAX_UPLOADS) throw error;
      photo.upload = null;
    }
  }
}

// Sends the files of a photo: the photo with the film that a phone recorded around it, a film, or
// the photos of a burst. Returns their key.
export async function upload(photo, context) {
  const { file, burst, film } = photo;
  const form = new FormData();
  for (const one of burst ?? [file]) form.append("photo", one, one.name);
  if (film) form.append("film", film, film.name);
  const { blob } = await request("photos", form, file, { ...context, job: null });
  photo.upload = JSON.parse(await blob.text()).key;
  return photo.upload;
}

// Sends a form. With the name of a `job`, it reports the work of the server, and without one the
// progress of the upload. `file` is the photo, for the messages of errors.
async function request(path, form, file, { job, signal, onProgress }) {
  for (let tries = 0; ; tries++) {
    const answer = await post(job ? `${path}?job=${job}` : path, job, form, signal, onProgress);
    if (answer.status === 200) return { blob: answer.response, fileName: fileNameOf(answer) };
    if (answer.status === 0) throw await connectionError();
    // of a full queue; errors of the device have none
    const retryAfter = answer.getResponseHeader("Retry-After");
    if (retryAfter === null || tries === MAX_RETRIES) throw await serverError(answer, file);
    onProgress({ phase: "waiting", ahead: 0 });
    await sleep(1000 * Number(retryAfter), signal);
  }
}

// Returns what the server can do: {models, takesFilms}. The `version` of a model changes when it or
// the program gives other results.
export async function abilities() {
  const [rows, health] = await Promise.all(["models", "health"].map(get));
  const models = rows.map((row) => ({ ...row, version: `${health.version} ${row.sha256}` }));
  return { models, takesFilms: health.takes_films };
}

async function get(path) {
  const response = await fetch(path);
  if (!response.ok) throw new Error(`status ${response.status}`);
  return response.json();
}

// Sends a form with XMLHttpRequest, because fetch() does not report the progress of an upload.
// Resolves with the request. The status of the request is 0 if there was no response.
function post(url, job, form, signal, onProgress) {
  const request = new XMLHttpRequest();
  let watcher = null;
  const stopWatching = () => watcher?.stop();
  return new Promise((resolve, reject) => {
    const abort = () => {
      reject(signal.reason); // first, because abort() fires loadend immediately
      request.abort();
    };
    if (signal.aborted) return abort();
    signal.addEventListener("abort", abort, { once: true });
    request.open("POST", url);
    request.responseType = "blob";
    if (job) {
      request.upload.onload = () => {
        watcher = pollProgress(job, onProgress);
      };
    } else {
      request.upload.onprogress = ({ loaded, total }) =>
        onProgress({ phase: "upload", loaded, total });
    }
    request.onprogress = ({ loaded }) => {
      stopWatching();
      const total = Number(request.getResponseHeader("Content-Length"));
      if (job && request.status === 200) onProgress({ phase: "download", loaded, total });
    };
    request.onloadend = () => {
      signal.removeEventListener("abort", abort);
      resolve(request);
    };
    request.send(form);
  }).finally(stopWatching);
}

function pollProgress(job, onProgress) {
  let timer = setTimeout(poll, POLL_MS);
  let started = null;
  let secondsLeft = null; // never rises while there is progress
  let last = { share: null, time: 0 };
  async function poll() {
    const response = await fetch(`progress/${job}`).catch(() => null);
    const progress = timer && response?.ok ? await response.json() : null;
    // Nothing is reported after stop(), because a late report overwrites a later phase.
    if (timer && progress) {
      const { state: phase, ahead, share, levels, preparing } = progress;
      if (phase === "working") started ??= performance.now();
      const seconds = (performance.now() - started) / 1000;
      if (share !== last.share) last = { share, time: performance.now() };
      if (performance.now() - last.time > STILL_MS) secondsLeft = null;
      else if (share >= MIN_SHARE && seconds > 1)
        secondsLeft = Math.min(secondsLeft ?? Infinity, (seconds / share) * (1 - share));
      onProgress({
        phase,
        ahead,
        share,
        preparing,
        secondsLeft,
        layers: levels ? `progress/${job}/layers?${levels}` : null,
      });
    }
    if (timer) timer = setTimeout(poll, POLL_MS);
  }
  return {
    stop() {
      clearTimeout(timer);
      timer = null;
    },
  };
}

function fileNameOf(request) {
  const name = /filename\*=UTF-8''([^;]+)/.exec(
    request.getResponseHeader("Content-Disposition") ?? "",
  );
  return name ? decodeURIComponent(name[1]) : "photo";
}

// If there is no response, either the server does not respond or the file cannot be read. Browsers
// do not report which of the two.
async function connectionError() {
  const response = await fetch("health").catch(() => null);
  if (!response)
    return new Error(
      "The server does not respond. Start it again if it was stopped, then try again.",
    );
  return new Error(
    "The photo was not sent. The file was moved, changed or deleted after it was added, " +
      "or the connection broke. Add it again.",
  );
}

async function serverError(request, file) {
  if (request.status === 401) return new Error(STALE_LINK);
  const body = await request.response
    .text()
    .then(JSON.parse)
    .catch(() => ({}));
  const message = sentence(body.error ?? `the server returned status ${request.status}`);
  const meaning =
    MEANINGS[body.kind === "UnreadablePhoto" && isVideo(file) ? "UnreadableVideo" : body.kind];
  return Object.assign(new Error(meaning ?? message), {
    status: request.status,
    details: meaning ? message : "",
    isFinal: body.kind in MEANINGS,
  });
}

const sentence = (text) => `${text[0].toUpperCase()}${text.slice(1).replace(/\.?$/, ".")}`;

function randomJobName() {
  return Array.from(crypto.getRandomValues(new Uint8Array(16)), (byte) =>
    byte.toString(16).padStart(2, "0"),
  ).join("");
}

// Waits; rejects as soon as the signal is aborted.
export function sleep(milliseconds, signal) {
  return new Promise((resolve, reject) => {
    if (signal.aborted) return reject(signal.reason);
    const timer = setTimeout(resolve, milliseconds);
    signal.addEventListener("abort", () => {
      clearTimeout(timer);
      reject(signal.reason);
    });
  });
}
