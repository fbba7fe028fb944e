// The views of the page: what its elements show in a state of the page.
//
// A state is a plain object, see `pageState` in app.js. Each view is a pure function that returns
// the properties of the elements of one part of the page, by their ids. `render` is the only
// function here that changes the page. What depends on the current photo is hidden while there is
// none.

import { byId, setBar } from "./dom.js";
import { photosOfLastStep } from "./edits.js";
import { isMeasured } from "./queue.js";
import { fraction, statusText, summarise } from "./status.js";
import { describeVerdict, hasMeasuredLayers, isNamingOpen } from "./verdict.js";

const LAYER_DESCRIPTIONS = {
  transmission: "The scene behind the glass.",
  reflection: "The light that the glass reflects.",
  confidence:
    "How certain the separation is. The file that you download is grey: white is certain.",
};
const VIEWS_OF_PAGE = [partsView, listView, layerView, downloadView];
const VIEWS_OF_PHOTO = [copyView, pictureView, waitingView, errorView, factsView, verdictView];

// Shows a state.
export function render(state) {
  const views = state.current ? [...VIEWS_OF_PAGE, ...VIEWS_OF_PHOTO] : VIEWS_OF_PAGE;
  for (const view of views) {
    for (const [id, properties] of Object.entries(view(state))) update(byId(id), properties);
  }
}

// Sets the properties that have changed. `share` is the value of a <progress>, and `src` the
// address of an image, or null.
function update(element, { share, src, ...properties }) {
  if (share !== undefined) setBar(element, share);
  if (src === null) element.removeAttribute("src");
  else if (src !== undefined && element.getAttribute("src") !== src) element.src = src;
  for (const [name, value] of Object.entries(properties)) {
    if (element[name] !== value) element[name] = value;
  }
}

const disabled = (isDisabled) => ({ ariaDisabled: String(isDisabled) });
const hidden = (isHidden) => ({ hidden: isHidden });

// The start page, or the parts of the page with photos.
function partsView({ current, isNoteShown, takesFilms }) {
  const hasPhoto = current !== null;
  return {
    advice: hidden(!takesFilms),
    "photos-only": hidden(takesFilms),
    "with-videos": hidden(!takesFilms),
    "and-videos": hidden(!takesFilms),
    welcome: hidden(hasPhoto),
    stage: hidden(!hasPhoto),
    panel: hidden(!hasPhoto),
    add: hidden(!hasPhoto),
    forget: hidden(!hasPhoto),
    strip: hidden(!hasPhoto && !isNoteShown),
  };
}

function listView({ photos, retriableCount, note, canUndoRemoval, isNoteShown, isBurstAsked }) {
  return {
    summary: { textContent: photos.length ? summarise(photos) : "" },
    "retry-all": hidden(retriableCount < 2),
    removed: hidden(!isNoteShown),
    "removed-text": { textContent: note },
    "undo-remove": hidden(!canUndoRemoval),
    burst: hidden(!isBurstAsked),
    copy: disabled(photos.length < 2),
  };
}

// What was copied to other photos, until the current photo is edited again.
function copyView({ current, photos }) {
  const count = photosOfLastStep(photos, current).length - 1;
  const isCopied = Boolean(current.edits.now.step) && count > 0;
  return {
    copied: hidden(!isCopied),
    "copied-text": { textContent: `Copied to ${count} other ${count === 1 ? "photo" : "photos"}.` },
    "copy-marks": hidden(photos.length < 2),
  };
}

function layerView({ current, layer }) {
  return {
    amount: { textContent: `${Math.round(100 * (current?.edits.strength ?? 1))} %` },
    "layer-description": { textContent: LAYER_DESCRIPTIONS[layer] },
    legend: hidden(layer !== "confidence"),
    download: { textContent: `Download ${layer}` },
  };
}

function downloadView({ photos, current, isReady, isExporting, zipLayers }) {
  // which layer is the transmission is not known before the question is answered
  const isDownloadable = isReady && !current.isUpdating && !isNamingOpen(current);
  const isAnySeparable = photos.some(({ state }) => state !== "failed");
  return {
    download: disabled(!isDownloadable || isExporting),
    all: disabled(isExporting || !isAnySeparable || !zipLayers.length),
  };
}

function pictureView({ isReady }) {
  return { compare: hidden(!isReady), "view-controls": { inert: !isReady } };
}

function waitingView({ current, isReady, isBurstAsked }) {
  const layersSoFar = current.progress?.layers;
  const isHeld = current.isHeld === true;
  return {
    waiting: hidden(isReady || current.state === "failed"),
    status: { textContent: statusText(current, isBurstAsked) },
    bar: { hidden: isHeld, share: fraction(current.progress) },
    cancel: hidden(isHeld),
    "so-far": { hidden: !layersSoFar, src: layersSoFar ?? null },
  };
}

function errorView({ current }) {
  const { file, state, error } = current;
  const [retryClass, discardClass] = error?.isFinal ? ["quiet", "main"] : ["main", "quiet"];
  return {
    error: hidden(state !== "failed"),
    "error-title": { textContent: error ? `${file.name} could not be separated` : "Cancelled" },
    "error-text": { textContent: error?.message ?? "" },
    "error-details": hidden(!error?.details),
    "error-message": { textContent: error?.details ?? "" },
    retry: { className: retryClass },
    discard: { className: discardClass },
  };
}

function factsView({ current, isReady }) {
  const facts = isReady ? [`${current.size.join(" × ")} pixels.`] : [];
  if (isReady && current.result.note) facts.push(`Note: ${current.result.note}.`);
  return { facts: { textContent: facts.join(" ") }, split: hidden(!current.burst) };
}

// The verdict below the picture, with what the user can do about it; and the question which of the
// measured layers is behind the glass.
function verdictView({ current, isReady, isBurstAsked, takesFilms }) {
  if (!isReady) return { verdict: hidden(true), naming: hidden(true) };
  const { result, isUpdating, edits, progress } = current;
  const { title, text } = describeVerdict(current);
  const isForced = edits.now.method === "motion";
  const isSeparated = hasMeasuredLayers(result);
  return {
    verdict: { hidden: false, className: isUpdating ? "updating" : "" },
    naming: hidden(isUpdating === true || !isNamingOpen(current)),
    "verdict-title": { textContent: isUpdating ? statusText(current, isBurstAsked) : title },
    "verdict-text": { textContent: text },
    "update-bar": { hidden: !isUpdating, share: fraction(progress) },
    swap: hidden(!isSeparated),
    measured: {
      hidden: !isForced && !(result.burst?.is_measured && !isSeparated),
      textContent: isForced ? "Show the automatic result" : "Use the measured layers anyway",
    },
    "film-next": hidden(isMeasured(current) || !result.next_step || !takesFilms),
  };
}
