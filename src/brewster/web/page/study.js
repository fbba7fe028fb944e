// The study's page: consent, then trial after trial, then thanks. The server knows where a participant stands; this
// page asks it, shows three pictures, and goes on when an answer is acknowledged.

import { Lens } from "./lens.js";

const PERSON = location.pathname.match(/^\/s\/([^/]+)/)?.[1];
const TOO_SOON = 300; // ms after new pictures in which no answer is taken: a second click was meant for the last ones
const KEYS = { 1: "left", 2: "similar", 3: "right", ArrowLeft: "left", ArrowRight: "right" }; // up and down scroll

const get = (id) => document.getElementById(id);
const sections = ["invitation", "trial", "finish", "trouble"];
const frames = { left: frame("left"), photo: frame("photo"), right: frame("right") };
const lens = new Lens(get("pictures"), Object.values(frames));
const preloaded = []; // keeps the pictures of the next trial in memory
let state = null; // the trial that is shown, as the server tells it
let shownAt = null; // when its pictures were there; null while no answer is taken

function frame(side) {
  return document.querySelector(`figure.${side} .frame`);
}

function show(section) {
  for (const id of sections) get(id).hidden = id !== section;
  get("head").hidden = section !== "trial";
}

// --- talking to the server

// The answer of the server. What the network swallowed is asked for again until it comes; what is refused is thrown.
async function ask(path, body) {
  for (let wait = 1; ; wait = Math.min(2 * wait, 15)) {
    try {
      const options = body && { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) };
      const answer = await fetch(path, options);
      if (answer.ok || isRefused(answer)) return await read(answer);
    } catch (error) {
      if (error instanceof Refused) throw error;
    }
    notice(body?.choice ? "Not saved yet: the server does not answer. Trying again…" : "The server does not answer. Trying again…");
    await new Promise((resolve) => setTimeout(resolve, 1000 * wait));
  }
}

class Refused extends Error {}

const isRefused = (answer) => answer.status >= 400 && answer.status < 500 && answer.status !== 408;

async function read(answer) {
  notice("");
  const told = await answer.json();
  if (!answer.ok) throw new Refused(told.error);
  return told;
}

function notice(text) {
  get("notice").textContent = text;
  get("notice").hidden = !text;
}

function fail(error) {
  get("why").textContent = error.message;
  show("trouble");
}

// --- consent

async function invite() {
  const invitation = await ask("/invitation");
  if (!invitation.is_open) throw new Refused("The study has all the participants that it needs. Thank you for coming.");
  for (const text of [...invitation.consent.split(/\n\s*\n/), `There are ${invitation.trials} comparisons.`]) {
    const paragraph = document.createElement("p");
    paragraph.textContent = text;
    get("consent").append(paragraph);
  }
  show("invitation");
}

get("agreement").addEventListener("submit", async (event) => {
  event.preventDefault();
  const button = event.target.querySelector("button");
  button.disabled = true;
  try {
    location.assign((await ask("/participants", { agreed: true })).link);
  } catch (error) {
    fail(error);
  }
});

// --- a trial

const address = (trial, side) => `/s/${PERSON}/pictures/${trial}/${side}`;

async function load(source) {
  for (let wait = 1; ; wait = Math.min(2 * wait, 15)) {
    const picture = new Image();
    picture.src = source;
    try {
      await picture.decode();
      notice("");
      return picture;
    } catch {
      const answer = await fetch(source).catch(() => null); // a picture does not say why it did not come
      if (answer && isRefused(answer)) await read(answer);
      notice("A picture has not arrived. Trying again…");
      await new Promise((resolve) => setTimeout(resolve, 1000 * wait));
    }
  }
}

async function present(next) {
  state = next;
  if (next.trial === null) return finish(next);
  const number = `Pair ${next.trial + 1} of ${next.trials}`;
  get("where").textContent = number;
  get("bar").value = next.trial / next.trials;
  get("trial").classList.add("waiting");
  show("trial");
  const sides = Object.keys(frames);
  await Promise.all(sides.map((side) => load(address(next.trial, side))));
  get("pictures").style.setProperty("--ratio", next.width / next.height);
  get("pictures").classList.toggle("tall", next.width < next.height);
  for (const side of sides) frames[side].firstElementChild.src = address(next.trial, side);
  await Promise.all(sides.map((side) => frames[side].firstElementChild.decode()));
  lens.reset(next.width, next.height);
  get("trial").classList.remove("waiting");
  mark(null, false);
  get("news").textContent = number;
  shownAt = performance.now();
  preloaded.length = 0;
  const ahead = next.trial + 1 < next.trials ? sides.map((side) => load(address(next.trial + 1, side))) : [];
  preloaded.push(...ahead.map((loading) => loading.catch(() => {}))); // what fails is told when its turn comes
}

// Says what was chosen, and whether it is too early or too late to choose. A button that is `disabled` would lose the focus.
function mark(choice, closed) {
  for (const button of get("choices").children) {
    button.setAttribute("aria-disabled", closed);
    button.classList.toggle("chosen", button.dataset.choice === choice);
  }
}

async function choose(choice) {
  if (shownAt === null || performance.now() - shownAt < TOO_SOON) return;
  const seconds = (performance.now() - shownAt) / 1000;
  shownAt = null;
  mark(choice, true);
  try {
    const answer = await ask(`/s/${PERSON}/answers`, { trial: state.trial, choice, seconds });
    await present(answer.next);
  } catch (error) {
    fail(error);
  }
}

function finish({ trials }) {
  get("done").textContent = `All ${trials} answers are saved.`;
  show("finish");
  get("thanks").focus();
}

for (const button of get("choices").children) button.addEventListener("click", () => choose(button.dataset.choice));

addEventListener("keydown", (event) => {
  if (get("trial").hidden || event.ctrlKey || event.metaKey || event.altKey) return;
  const answers = event.key in KEYS ? !event.shiftKey : event.key === "Enter" && get("choices").contains(event.target);
  if (event.repeat && answers) return event.preventDefault(); // a key that is held is one answer
  if (event.shiftKey ? lens.press(`Shift+${event.key}`) || lens.press(event.key) : lens.press(event.key)) event.preventDefault();
  else if (event.key in KEYS && !event.shiftKey) {
    event.preventDefault();
    choose(KEYS[event.key]);
  }
});

for (const button of get("zoom").children) button.addEventListener("click", () => lens.zoom(button.dataset.zoom));
get("pictures").addEventListener("zoomed", () => {
  document.querySelector("[data-zoom=full]").setAttribute("aria-pressed", lens.isFull);
});

get("copy").addEventListener("click", async () => {
  const link = new URL((await ask(`/s/${PERSON}/link`)).link, location.href).href;
  try {
    await navigator.clipboard.writeText(link);
    notice("Your link is copied. Keep it for yourself.");
  } catch {
    notice(`Your link: ${link}`);
  }
  setTimeout(() => notice(""), 8000);
});
get("again").addEventListener("click", () => location.reload());

try {
  await (PERSON ? present(await ask(`/s/${PERSON}/trial`)) : invite());
} catch (error) {
  fail(error);
}
