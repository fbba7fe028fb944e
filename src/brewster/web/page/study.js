// The page of the user study: consent, trials, end. The server stores the progress of a
// participant. The page requests the next trial, shows its three pictures, sends the answer, and
// continues after the server has acknowledged it.

import { PanZoom } from "./pan_zoom.js";

const PARTICIPANT_TOKEN = location.pathname.match(/^\/s\/([^/]+)/)?.[1];
// In ms. Earlier answers are ignored, because they may be the second click of a double click in the
// previous trial.
const MIN_ANSWER_DELAY = 300;
// in CSS px; in a narrower window, pictures side by side are too small to compare
const MIN_WIDTH = 900;
const NOTICE_SECONDS = 8; // how long a notice is shown that needs no action
// the up and down arrows scroll
const CHOICE_KEYS = { 1: "left", 2: "similar", 3: "right", ArrowLeft: "left", ArrowRight: "right" };

const byId = (id) => document.getElementById(id);
const sections = ["invitation", "trial", "finish", "error"];
const frames = { left: frame("left"), photo: frame("photo"), right: frame("right") };
const panZoom = new PanZoom(byId("pictures"), Object.values(frames));
const captions = { left: "Result A", photo: "Photo", right: "Result B" };
const preloaded = []; // the pictures of the next trial, held in memory
let currentTrial = null; // the current trial, as returned by the server
let practising = false; // whether the practice trial is shown
let switches = 0; // how often another picture was shown in place during the trial
let zoomed = false; // whether the pictures were enlarged during the trial
let noticeTimer; // the timer that removes the notice
// time at which the pictures of the trial were shown; null while no answer is accepted
let shownAt = null;

function frame(side) {
  return document.querySelector(`figure.${side} .frame`);
}

function show(section) {
  for (const id of sections) byId(id).hidden = id !== section;
  byId("head").hidden = section !== "trial";
}

// --- requests

// Sends a request and returns the data of the response. Repeats the request after a network or
// server error, and throws after a client error.
async function send(path, body) {
  for (let wait = 1; ; wait = Math.min(2 * wait, 15)) {
    try {
      const options = body && {
        method: "POST",
        headers: { "Content-Type": "application/json" },
        body: JSON.stringify(body),
      };
      const response = await fetch(path, options);
      if (response.ok || isClientError(response)) return await parse(response);
    } catch (error) {
      if (error instanceof RequestError) throw error;
    }
    const happened = body?.choice
      ? "Your answer is not saved yet, because the server does not respond."
      : "The server does not respond.";
    showNotice(
      `${happened} Expected a connection to the server. Keep this page open: it tries again.`,
    );
    await new Promise((resolve) => setTimeout(resolve, 1000 * wait));
  }
}

class RequestError extends Error {}

const isClientError = (response) =>
  response.status >= 400 && response.status < 500 && response.status !== 408;

async function parse(response) {
  showNotice("");
  if (response.ok) return response.json();
  // a proxy may answer with a page instead of JSON
  const { error } = await response.json().catch(() => ({}));
  throw new RequestError(
    error
      ? sentences(error)
      : `The server refused the request (status ${response.status}). Expected a response of the ` +
          "study. Load the page again. If this does not help, tell it to the person who runs it.",
  );
}

// Returns the three parts of a message of the server, which are separated by semicolons, as
// sentences.
function sentences(message) {
  return message
    .split("; ")
    .map((part) => part[0].toUpperCase() + part.slice(1).replace(/\.?$/, "."))
    .join(" ");
}

// Shows a notice until the next one, or for `seconds`. An empty text removes the notice.
function showNotice(text, seconds) {
  clearTimeout(noticeTimer); // otherwise the timer of the previous notice would remove this one
  byId("notice").textContent = text;
  byId("notice").hidden = !text;
  if (seconds) noticeTimer = setTimeout(() => showNotice(""), 1000 * seconds);
}

function showError(error) {
  byId("error-text").textContent = error.message;
  show("error");
}

// --- consent

async function showInvitation() {
  const invitation = await send("/invitation");
  for (const text of [
    ...invitation.consent.split(/\n\s*\n/),
    `There are ${invitation.trials} comparisons.`,
  ]) {
    const paragraph = document.createElement("p");
    paragraph.textContent = text;
    byId("consent").append(paragraph);
  }
  show("invitation");
}

byId("agreement").addEventListener("submit", async (event) => {
  event.preventDefault();
  const button = event.target.querySelector("button");
  button.disabled = true;
  try {
    location.assign((await send("/participants", { agreed: true })).link);
  } catch (error) {
    showError(error);
  }
});

// --- window and arrangement

function warnIfNarrow() {
  byId("narrow-page").textContent =
    `This window is ${innerWidth} pixels wide. The pictures are easier to compare in a window of ` +
    `at least ${MIN_WIDTH} pixels: enlarge it, turn the device, or use a computer.`;
  // short, because it takes space from the pictures
  byId("narrow-trial").textContent = `Small window (${innerWidth} px): enlarge it if you can.`;
  for (const id of ["narrow-page", "narrow-trial"]) byId(id).hidden = innerWidth >= MIN_WIDTH;
}

const view = () => byId("pictures").dataset.view;
const shownSide = () =>
  Object.keys(frames).find((side) => frames[side].parentElement.classList.contains("shown"));

function setView(name) {
  byId("pictures").dataset.view = name;
  byId("flip").hidden = name !== "single";
  for (const button of byId("views").children)
    button.setAttribute("aria-pressed", button.dataset.view === name);
  if (name === "single" && !shownSide()) showInPlace("left");
}

// Shows one picture instead of all three.
function showInPlace(side) {
  switches += view() === "single" && shownSide() !== side;
  for (const [name, element] of Object.entries(frames))
    element.parentElement.classList.toggle("shown", name === side);
  for (const button of byId("flip").children)
    button.setAttribute("aria-pressed", button.dataset.side === side);
  if (view() !== "single") setView("single");
  byId("announcement").textContent = captions[side];
}

const VIEW_KEYS = {
  a: () => showInPlace("left"),
  b: () => showInPlace("right"),
  p: () => showInPlace("photo"),
  x: () => showInPlace(view() === "single" && shownSide() === "left" ? "right" : "left"),
  s: () => setView("all"),
  d: () => setView("pair"),
};

// Returns the viewing conditions, with lengths in CSS px.
function viewingConditions() {
  return {
    viewport_width: innerWidth,
    viewport_height: innerHeight,
    pixel_ratio: devicePixelRatio,
    picture_width: Math.round(frames.left.getBoundingClientRect().width),
    theme: matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light",
    pointer: matchMedia("(pointer: coarse)").matches ? "coarse" : "fine",
    view: view(),
    switches,
    zoomed: zoomed || panZoom.isZoomed,
  };
}

// --- pictures

const pictureUrl = (trial, side) => `/s/${PARTICIPANT_TOKEN}/pictures/${trial}/${side}`;

async function loadPicture(source) {
  for (let wait = 1; ; wait = Math.min(2 * wait, 15)) {
    const picture = new Image();
    picture.src = source;
    try {
      await picture.decode();
      // removes the notice of the failed attempts, but no other notice
      if (wait > 1) showNotice("");
      return picture;
    } catch {
      // an image element does not report the reason of a failure
      const response = await fetch(source).catch(() => null);
      if (response && isClientError(response)) await parse(response);
      showNotice(
        "A picture could not be loaded. Expected a connection to the server. " +
          "Keep this page open: it tries again.",
      );
      await new Promise((resolve) => setTimeout(resolve, 1000 * wait));
    }
  }
}

// --- a trial

// Shows the practice trial before the first trial, then the trials.
async function start(next) {
  practising = Boolean(next.practice);
  if (!practising) return showTrial(next);
  currentTrial = next;
  byId("bar").value = 0;
  await showPictures("practice", next.practice, "Practice: not counted");
}

async function showTrial(next) {
  practising = false;
  currentTrial = next;
  byId("undo").hidden = next.last === null;
  if (next.trial === null) return finish(next);
  byId("bar").value = next.trial / next.trials;
  await showPictures(next.trial, next, `Pair ${next.trial + 1} of ${next.trials}`);
  preload(next);
}

// Shows the three pictures of a trial, and then accepts answers. `trial` is its number or
// "practice".
async function showPictures(trial, { width, height }, title) {
  byId("position").textContent = title;
  byId("trial").classList.add("waiting");
  show("trial");
  const sides = Object.keys(frames);
  await Promise.all(sides.map((side) => loadPicture(pictureUrl(trial, side))));
  byId("pictures").style.setProperty("--ratio", width / height);
  byId("pictures").classList.toggle("tall", width < height);
  for (const side of sides) frames[side].firstElementChild.src = pictureUrl(trial, side);
  await Promise.all(sides.map((side) => frames[side].firstElementChild.decode()));
  panZoom.reset(width, height);
  if (view() === "single") showInPlace("left");
  switches = 0;
  zoomed = panZoom.isZoomed;
  byId("trial").classList.remove("waiting");
  updateChoices(null, false);
  byId("announcement").textContent = title;
  shownAt = performance.now();
}

// Loads the pictures of the trial after `next`.
function preload(next) {
  const sides = Object.keys(frames);
  preloaded.length = 0;
  const ahead =
    next.trial + 1 < next.trials
      ? sides.map((side) => loadPicture(pictureUrl(next.trial + 1, side)))
      : [];
  // an error is shown when the trial is shown
  preloaded.push(...ahead.map((loading) => loading.catch(() => {})));
}

// Marks the chosen button, and shows whether choices are accepted. Uses aria-disabled, because a
// button with the attribute `disabled` loses the focus.
function updateChoices(choice, closed) {
  for (const button of byId("choices").children) {
    button.setAttribute("aria-disabled", closed);
    button.classList.toggle("chosen", button.dataset.choice === choice);
  }
}

// --- answers

async function choose(choice) {
  if (shownAt === null || performance.now() - shownAt < MIN_ANSWER_DELAY) return;
  const seconds = (performance.now() - shownAt) / 1000;
  shownAt = null;
  updateChoices(choice, true);
  try {
    if (practising) return await endPractice(choice);
    const body = { trial: currentTrial.trial, choice, seconds, conditions: viewingConditions() };
    const answer = await send(`/s/${PARTICIPANT_TOKEN}/answers`, body);
    await showTrial(answer.next);
  } catch (error) {
    showError(error);
  }
}

// Explains the practice pair, and shows the first trial.
async function endPractice(choice) {
  const better = currentTrial.practice.expected === "left" ? "A" : "B";
  const isRight = choice === currentTrial.practice.expected;
  const text =
    `${isRight ? "Yes" : "Look again at such differences"}: ${better} is better, ` +
    "because the other result was blurred. The study begins now.";
  await showTrial(currentTrial);
  showNotice(text, NOTICE_SECONDS);
}

async function undo() {
  // an answer is being sent
  if (currentTrial.last === null || (currentTrial.trial !== null && shownAt === null)) return;
  shownAt = null;
  try {
    await showTrial(
      await send(`/s/${PARTICIPANT_TOKEN}/withdrawals`, { trial: currentTrial.last }),
    );
    byId("undo").hidden = true; // only one answer can be undone in a row
  } catch (error) {
    showError(error);
  }
}

function finish({ trials }) {
  byId("done").textContent = `All ${trials} answers are saved.`;
  show("finish");
  byId("thanks").focus();
}

// --- controls

for (const button of byId("choices").children)
  button.addEventListener("click", () => choose(button.dataset.choice));

addEventListener("keydown", (event) => {
  if (byId("trial").hidden || event.ctrlKey || event.metaKey || event.altKey) return;
  const isAnswerKey =
    event.key in CHOICE_KEYS
      ? !event.shiftKey
      : event.key === "Enter" && byId("choices").contains(event.target);
  if (event.repeat && isAnswerKey) return event.preventDefault(); // a held key counts as one answer
  if (
    event.shiftKey
      ? panZoom.press(`Shift+${event.key}`) || panZoom.press(event.key)
      : panZoom.press(event.key)
  )
    event.preventDefault();
  else if (event.key in CHOICE_KEYS && !event.shiftKey) {
    event.preventDefault();
    choose(CHOICE_KEYS[event.key]);
  } else if (event.key.toLowerCase() in VIEW_KEYS && !event.repeat)
    VIEW_KEYS[event.key.toLowerCase()]();
});

for (const button of byId("views").children)
  button.addEventListener("click", () => setView(button.dataset.view));
for (const button of byId("flip").children)
  button.addEventListener("click", () => showInPlace(button.dataset.side));
for (const id of ["undo", "undo-last"]) byId(id).addEventListener("click", undo);
addEventListener("resize", warnIfNarrow);
warnIfNarrow();

for (const button of byId("zoom").children)
  button.addEventListener("click", () => panZoom.zoom(button.dataset.zoom));
byId("pictures").addEventListener("zoomed", () => {
  zoomed ||= panZoom.isZoomed;
  document.querySelector("[data-zoom=full]").setAttribute("aria-pressed", panZoom.isFull);
});

byId("copy").addEventListener("click", async () => {
  const answer = await send(`/s/${PARTICIPANT_TOKEN}/link`).catch(showError);
  if (!answer) return;
  const link = new URL(answer.link, location.href).href;
  try {
    await navigator.clipboard.writeText(link);
    showNotice("Your link is copied. Do not share it.", NOTICE_SECONDS);
  } catch {
    showNotice(`Your link: ${link}`, NOTICE_SECONDS);
  }
});
byId("retry").addEventListener("click", () => location.reload());

try {
  await (PARTICIPANT_TOKEN ? start(await send(`/s/${PARTICIPANT_TOKEN}/trial`)) : showInvitation());
} catch (error) {
  showError(error);
}
