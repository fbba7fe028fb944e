// The client of the HTTP API. A failed request throws an Error whose message can be shown to the user.

const POLL_MS = 300;
const MAX_RETRIES = 60; // maximum number of repetitions of a request while the queue of the server is full

// Sends a photo with options to a path and returns the response. Until then, it calls `onProgress({state, ahead, share})`
// repeatedly; `share` is the completed fraction.
export async function send(path, file, options, { signal, onProgress }) {
  const form = new FormData();
  for (const [name, value] of Object.entries(options)) form.append(name, value);
  form.append("photo", file, file.name);
  for (let tries = 0; ; tries++) {
    const job = randomJobName();
    const watcher = pollProgress(job, onProgress);
    const response = await fetch(`${path}?job=${job}`, { method: "POST", body: form, signal })
      .catch((error) => throwNetworkError(error))
      .finally(() => watcher.stop());
    if (response.ok) return response;
    if (response.status !== 503 || tries === MAX_RETRIES) throw new Error(await errorMessage(response));
    onProgress({ state: "waiting", share: 0 });
    await sleep(1000 * Number(response.headers.get("Retry-After") ?? 5), signal);
  }
}

// Returns the available models.
export async function models() {
  const response = await fetch("models").catch(throwNetworkError);
  if (!response.ok) throw new Error(await errorMessage(response));
  return response.json();
}

// The file name in the Content-Disposition header of a response.
export function fileNameOf(response) {
  const name = /filename\*=UTF-8''([^;]+)/.exec(response.headers.get("Content-Disposition") ?? "");
  return name ? decodeURIComponent(name[1]) : "photo";
}

function pollProgress(job, onProgress) {
  let timer = setTimeout(poll, POLL_MS);
  async function poll() {
    const response = await fetch(`progress/${job}`).catch(() => null);
    const progress = timer && response?.ok ? await response.json() : null;
    if (timer && progress) onProgress(progress); // not after stop(): a late report would overwrite the state "done"
    if (timer) timer = setTimeout(poll, POLL_MS);
  }
  return {
    stop() {
      clearTimeout(timer);
      timer = null;
    },
  };
}

function throwNetworkError(error) {
  if (error.name === "AbortError") throw error;
  throw new Error("The server does not respond. Start it again if it was stopped, then try again.");
}

async function errorMessage(response) {
  const body = await response.json().catch(() => ({}));
  const message = body.error ?? `the server returned status ${response.status}`;
  return `${message[0].toUpperCase()}${message.slice(1).replace(/\.?$/, ".")}`;
}

function randomJobName() {
  return Array.from(crypto.getRandomValues(new Uint8Array(16)), (byte) => byte.toString(16).padStart(2, "0")).join("");
}

function sleep(milliseconds, signal) {
  return new Promise((resolve, reject) => {
    const timer = setTimeout(resolve, milliseconds);
    signal.addEventListener("abort", () => {
      clearTimeout(timer);
      reject(signal.reason);
    });
  });
}
