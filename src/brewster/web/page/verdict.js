// The verdict of a separation in words: short for the list, the summary and the report, and long
// for the picture.

import { methodOf } from "./queue.js";

// The short verdicts in the order of the summary. The first five are those of single photos and of
// measured layers, the others those of bursts only.
export const VERDICTS = [
  "removed",
  "partly removed",
  "reflection remains",
  "little found",
  "doubtful",
  "separated by light",
  "open question",
  "single photo",
  "unchanged",
];

const TITLES = {
  removed: "A reflection was found and removed.",
  "partly removed": "A reflection was found and partly removed.",
  "reflection remains": "A reflection was found, but most of it remains.",
  "little found": "Little reflection was found.",
  doubtful: "The layers may be wrong. Check them.",
  "separated by light": "The layers were separated by the change of the light.",
  "open question": "The layers were separated.",
  "single photo": "One picture was separated alone.",
  unchanged: "The picture stays as it is.",
};

// Whether the result has two measured layers, which may be exchanged.
export const hasMeasuredLayers = (result) => ["burst", "light"].includes(methodOf(result));

// Whether the user must decide which of the two measured layers is behind the glass.
export const isNamingOpen = ({ result, edits }) =>
  hasMeasuredLayers(result) && !result.burst.are_names_certain && edits.now.swap === null;

// Returns the short verdict of a photo that is done.
export function verdictOf(photo) {
  const method = methodOf(photo.result);
  const { verdict } = photo.result.assessment;
  if (isNamingOpen(photo)) return "open question";
  if (method === "burst") return verdict;
  if (method === "unchanged" && verdict === "doubtful") return verdict;
  if (method === "light") return "separated by light";
  return photo.isBurst || method === "unchanged" ? method : verdict;
}

// Returns a sentence about the result, and a second one with the reason or with the next step.
export function describeVerdict(photo) {
  const { burst, next_step: nextStep } = photo.result;
  const method = methodOf(photo.result);
  const { method: requested, swap } = photo.edits.now;
  let title = TITLES[method === "unchanged" ? method : verdictOf(photo)];
  if (method === "burst" && requested === "motion")
    title = "The measured layers are shown, as you asked. Check them.";
  if (hasMeasuredLayers(photo.result) && swap) title = "The layers are exchanged, as you asked.";
  if (!burst?.film) return { title, text: burst?.message ?? nextStep ?? "" };
  const seconds = burst.film.seconds.toFixed(1);
  return { title, text: `This photo contains a film of ${seconds} s. ${burst.message}` };
}
