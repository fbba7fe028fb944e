// The page of the user study: consent, trials, end. The server stores the progress of a participant. The page requests
// the next trial, shows its three pictures, sends the answer, and continues after the server has acknowledged it.

import { PanZoom } from "./pan_zoom.js";

const PARTICIPANT_TOKEN = location.pathname.match(/^\/s\/([^/]+)/)?.[1];
// In ms. Earlier answers are ignored, because they may be the second click of a double click in the previous trial.
const MIN_ANSWER_DELAY = 300;
const KEYS = { 1: "left", 2: "similar", 3: "right", ArrowLeft: "left", ArrowRight: "right" }; // the up and down arrows scroll

const byId = (id) => document.getElementById(id);
const sections = ["invitation", "trial", "finish", "error"];
const frames = { left: frame("left"), photo: frame("photo"), right: frame("right") };
const panZoom = new PanZoom(byId("pictures"), Object.values(frames));
const preloaded = []; // the pictures of the next trial, held in memory
let state = null; // the current trial, as returned by the server
let shownAt = null; // time at which its pictures were shown; null while no answer is accepted

function frame(side) {
  return document.querySelector(`figure.${side} .frame`);
}

function show(section) {
  for (const id of sections) byId(id).hidden = id !== section;
  byId("head").hidden = section !== "trial";
}

// --- requests

// Sends a request and returns the data of the response. Repeats the request after a network or server error, and throws after
// a client error.
async function send(path, body) {
  for (let wait = 1; ; wait = Math.min(2 * wait, 15)) {
    try {
      const options = body && { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) };
      const response = await fetch(path, options);
      if (response.ok || isClientError(response)) return await parse(response);
    } catch (error) {
      if (error instanceof RequestError) throw error;
    }
    notice(body?.choice ? "Not saved yet: the server does not respond. Trying again…" : "The server does not respond. Trying again…");
    await new Promise((resolve) => setTimeout(resolve, 1000 * wait));
  }
}

class RequestError extends Error {}

const isClientError = (response) => response.status >= 400 && response.status < 500 && response.status !== 408;

async function parse(response) {
  notice("");
  const data = await response.json();
  if (!response.ok) throw new RequestError(data.error);
  return data;
}

function notice(text) {
  byId("notice").textContent = text;
  byId("notice").hidden = !text;
}

function showError(error) {
  byId("error-text").textContent = error.message;
  show("error");
}

// --- consent

async function showInvitation() {
  const invitation = await send("/invitation");
  if (!invitation.is_open) throw new RequestError("The study has all the participants that it needs. Thank you for your interest.");
  for (const text of [...invitation.consent.split(/\n\s*\n/), `There are ${invitation.trials} comparisons.`]) {
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

// --- a trial

const pictureUrl = (trial, side) => `/s/${PARTICIPANT_TOKEN}/pictures/${trial}/${side}`;

async function loadPicture(source) {
  for (let wait = 1; ; wait = Math.min(2 * wait, 15)) {
    const picture = new Image();
    picture.src = source;
    try {
      await picture.decode();
      notice("");
      return picture;
    } catch {
      const response = await fetch(source).catch(() => null); // an image element does not report the reason of a failure
      if (response && isClientError(response)) await parse(response);
      notice("A picture could not be loaded. Trying again…");
      await new Promise((resolve) => setTimeout(resolve, 1000 * wait));
    }
  }
}

async function showTrial(next) {
  state = next;
  if (next.trial === null) return finish(next);
  const number = `Pair ${next.trial + 1} of ${next.trials}`;
  byId("position").textContent = number;
  byId("bar").value = next.trial / next.trials;
  byId("trial").classList.add("waiting");
  show("trial");
  const sides = Object.keys(frames);
  await Promise.all(sides.map((side) => loadPicture(pictureUrl(next.trial, side))));
  byId("pictures").style.setProperty("--ratio", next.width / next.height);
  byId("pictures").classList.toggle("tall", next.width < next.height);
  for (const side of sides) frames[side].firstElementChild.src = pictureUrl(next.trial, side);
  await Promise.all(sides.map((side) => frames[side].firstElementChild.decode()));
  panZoom.reset(next.width, next.height);
  byId("trial").classList.remove("waiting");
  updateChoices(null, false);
  byId("announcement").textContent = number;
  shownAt = performance.now();
  preloaded.length = 0;
  const ahead = next.trial + 1 < next.trials ? sides.map((side) => loadPicture(pictureUrl(next.trial + 1, side))) : [];
  preloaded.push(...ahead.map((loading) => loading.catch(() => {}))); // an error is shown when the trial is shown
}

// Marks the chosen button, and whether choices are accepted. A button with the attribute `disabled` would lose the focus.
function updateChoices(choice, closed) {
  for (const button of byId("choices").children) {
    button.setAttribute("aria-disabled", closed);
    button.classList.toggle("chosen", button.dataset.choice === choice);
  }
}

async function choose(choice) {
  if (shownAt === null || performance.now() - shownAt < MIN_ANSWER_DELAY) return;
  const seconds = (performance.now() - shownAt) / 1000;
  shownAt = null;
  updateChoices(choice, true);
  try {
    const answer = await send(`/s/${PARTICIPANT_TOKEN}/answers`, { trial: state.trial, choice, seconds });
    await showTrial(answer.next);
  } catch (error) {
    showError(error);
  }
}

function finish({ trials }) {
  byId("done").textContent = `All ${trials} answers are saved.`;
  show("finish");
  byId("thanks").focus();
}

for (const button of byId("choices").children) button.addEventListener("click", () => choose(button.dataset.choice));

addEventListener("keydown", (event) => {
  if (byId("trial").hidden || event.ctrlKey || event.metaKey || event.altKey) return;
  const answers = event.key in KEYS ? !event.shiftKey : event.key === "Enter" && byId("choices").contains(event.target);
  if (event.repeat && answers) return event.preventDefault(); // a held key counts as one answer
  if (event.shiftKey ? panZoom.press(`Shift+${event.key}`) || panZoom.press(event.key) : panZoom.press(event.key)) event.preventDefault();
  else if (event.key in KEYS && !event.shiftKey) {
    event.preventDefault();
    choose(KEYS[event.key]);
  }
});

for (const button of byId("zoom").children) button.addEventListener("click", () => panZoom.zoom(button.dataset.zoom));
byId("pictures").addEventListener("zoomed", () => {
  document.querySelector("[data-zoom=full]").setAttribute("aria-pressed", panZoom.isFull);
});

byId("copy").addEventListener("click", async () => {
  const link = new URL((await send(`/s/${PARTICIPANT_TOKEN}/link`)).link, location.href).href;
  try {
    await navigator.clipboard.writeText(link);
    notice("Your link is copied. Do not share it.");
  } catch {
    notice(`Your link: ${link}`);
  }
  setTimeout(() => notice(""), 8000);
});
byId("retry").addEventListener("click", () => location.reload());

try {
  await (PARTICIPANT_TOKEN ? showTrial(await send(`/s/${PARTICIPANT_TOKEN}/trial`)) : showInvitation());
} catch (error) {
  showError(error);
}
