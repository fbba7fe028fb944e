// The state of the photos and of requests in words.

import { isVideo } from "./drop.js";
import { VERDICTS, verdictOf } from "./verdict.js";

export const WAITING_FOR_ANSWER = "Waiting for your answer: are these photos of one window?";

// Whether the first film after an installation waits for what the server compiles.
const isPreparing = ({ phase, preparing }) => phase === "working" && typeof preparing === "number";

const megabytes = (bytes) => (bytes / 1e6).toFixed(bytes < 9.95e6 ? 1 : 0);

// Returns the state of a photo in a word, for the list.
export function shortStatus(photo) {
  const { state, progress, error } = photo;
  if (state === "failed") return error ? "failed" : "cancelled";
  if (state === "done") return verdictOf(photo);
  if (state !== "working") return state;
  if (isPreparing(progress)) return "preparing";
  if (progress.phase === "working") return `${Math.round(100 * progress.share)} %`;
  return progress.phase === "upload" ? "sending" : "receiving";
}

// Returns the state of a photo that is not shown yet, in words. `isBurstAsked`: whether the user is
// asked if photos are a burst.
export function statusText({ state, progress, isHeld }, isBurstAsked) {
  if (isHeld) return isBurstAsked ? WAITING_FOR_ANSWER : "Comparing the photos";
  if (state === "working") return progressText(progress);
  if (state === "done") return "Finishing"; // its pictures are being read
  return progress?.ahead ? `Waiting, ${progress.ahead} before this photo` : "Waiting";
}

// Returns the progress of a request (see `send` in api.js) in words.
export function progressText(progress) {
  if (progress.phase === "waiting") return "Waiting for the server";
  if (isPreparing(progress)) {
    return `Preparing films (once), ${Math.floor(100 * progress.preparing)} %`;
  }
  if (progress.phase === "working" && progress.share > 0.99) return "Finishing";
  if (progress.phase === "working") {
    return `Separating, ${Math.floor(100 * progress.share)} %${timeLeft(progress.secondsLeft)}`;
  }
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
  if (isPreparing(progress)) return progress.preparing;
  if (progress.phase === "working") return progress.share;
  return progress.total ? progress.loaded / progress.total : null;
}

function kindOf({ file, burst }) {
  if (burst) return "burst";
  return isVideo(file) ? "film" : "photo";
}

// Returns a summary such as "1 film, 12 photos: 9 partly removed, 4 failed", or "1 film: separated
// by motion".
export function summarise(photos) {
  const names = photos.map((photo) => (photo.state === "done" ? verdictOf(photo) : photo.state));
  const order = [...VERDICTS, "working", "waiting", "failed"];
  const counted = order
    .map((name) => [names.filter((one) => one === name).length, name])
    .filter(([count]) => count);
  const states = photos.length === 1 ? names : counted.map((part) => part.join(" "));
  const kinds = ["film", "burst", "photo"]
    .map((kind) => [photos.filter((photo) => kindOf(photo) === kind).length, kind])
    .filter(([count]) => count)
    .map(([count, kind]) => `${count} ${kind}${count === 1 ? "" : "s"}`);
  return `${kinds.join(", ")}: ${states.join(", ")}`;
}
