"use strict";
{
  const data = JSON.parse(document.getElementById("data").textContent);
  const list = document.getElementById("cases");
  const form = document.forms[0];
  const dialog = document.querySelector("dialog");
  const [heading, footer] = ["h2", "footer"].map(part => dialog.querySelector(part));
  const rank = button => ["picture", "error", "reflection", "region"].indexOf(button.dataset.kind);
  const cases = [...list.querySelectorAll("article")].map((element, i) => ({
    element, scores: data.scores[i], benchmark: element.dataset.benchmark, name: element.dataset.name,
    buttons: [...element.querySelectorAll(".thumbnails button")].sort((a, b) => rank(a) - rank(b)),
  }));

  // --- sort and filter; the URL fragment stores the settings that differ from the defaults, so that a view can be shared

  const measured = (metric, method) => cases.some(item => item.scores[method]?.[metric] != null);
  const metrics = Object.keys(data.metrics).filter(metric => data.methods.some(method => measured(metric, method)));
  const defaults = {
    sort: metrics[0] ?? "", of: data.methods.find(method => method !== data.baseline) ?? data.baseline, by: "score", order: "worst",
    benchmark: "", name: "", open: "", layer: "",
  };
  let state = {...defaults};

  function addOptions(name, rows) {
    form.elements[name].append(...rows.map(([value, text]) => new Option(text, value)));
  }
  addOptions("sort", metrics.map(metric => [metric, data.metrics[metric].title]));
  addOptions("of", data.methods.map(method => [method, method]));
  addOptions("benchmark", Object.entries(data.benchmarks));
  form.elements.by.disabled = !data.methods.includes(data.baseline);
  form.hidden = false;

  function value(item) {
    const score = item.scores[state.of]?.[state.sort];
    const baseline = state.by === "difference" ? item.scores[data.baseline]?.[state.sort] : 0;
    return score == null || baseline == null ? null : score - baseline;
  }

  function scoreText(number) {
    const metric = data.metrics[state.sort];
    if (!metric) return "";
    const title = `· ${metric.title} of ${state.of}${state.by === "difference" ? ", difference" : ""}: `;
    if (number === null) return title + "none";
    const sign = state.by === "difference" && number > 0 ? "+" : "";
    return title + sign + number.toFixed(metric.digits).replace("-", "\u2212") + (metric.unit ? "\u00a0" + metric.unit : "");
  }

  function sortAndFilter() {
    const direction = (data.metrics[state.sort]?.higher ? 1 : -1) * (state.order === "worst" ? 1 : -1);
    const rows = cases.map(item => [item, value(item)]);
    rows.sort(([, a], [, b]) => (a === null) - (b === null) || direction * (a - b));
    for (const [item, number] of rows) item.element.querySelector(".key").textContent = scoreText(number);
    list.append(...rows.map(([item]) => item.element));
    const searchText = state.name.toLowerCase();
    for (const item of cases) {
      const isInBenchmark = !state.benchmark || item.benchmark === state.benchmark;
      item.element.hidden = !(isInBenchmark && item.name.toLowerCase().includes(searchText));
    }
    form.querySelector("output").value = `${visible().length} of ${cases.length} images`;
  }

  function visible() {
    const caseOf = new Map(cases.map(item => [item.element, item]));
    return [...list.querySelectorAll("article:not([hidden])")].map(element => caseOf.get(element));
  }

  function writeFragment() {
    const changed = Object.entries(state).filter(([key, text]) => text !== defaults[key]);
    history.replaceState(null, "", changed.length ? "#" + new URLSearchParams(changed) : location.pathname + location.search);
  }

  function readFragment() {
    state = {...defaults};
    for (const [key, text] of new URLSearchParams(location.hash.slice(1))) if (key in state) state[key] = text;
    for (const control of form.elements) {
      if (!(control.name in state)) continue;
      control.value = state[control.name];
      if (control.value !== state[control.name]) control.value = state[control.name] = defaults[control.name];
    }
    sortAndFilter();
    const item = cases.find(item => id(item) === state.open);
    if (item) show(item, Math.max(0, item.buttons.findIndex(button => caption(button) === state.layer)));
    else if (dialog.open) dialog.close();
  }

  form.addEventListener("input", event => {
    state[event.target.name] = event.target.value;
    sortAndFilter();
    writeFragment();
  });
  form.addEventListener("submit", event => event.preventDefault());
  addEventListener("hashchange", readFragment);

  // --- viewer: the images of a case have the same position, and one zoom and one centre for all of them

  let current = null, at = 0;
  const view = {zoom: 1, x: 0, y: 0, fits: true};  // CSS pixels per image pixel, and the image point in the centre of a pane
  const stage = dialog.querySelector(".stage");
  const [one, other, amplification] = ["one", "other", "amplification"].map(name => dialog.querySelector(`[name=${name}]`));
  const toggle = name => dialog.querySelector(`button[value=${name}]`);
  const isOn = name => toggle(name).getAttribute("aria-pressed") === "true";
  const id = item => `${item.benchmark}/${item.name}`;
  const caption = button => button.parentElement.querySelector("figcaption").textContent;

  function show(item, layer) {
    if (item !== current) fill(item);
    at = layer;
    const kind = item.buttons[at].dataset.kind;
    [...stage.querySelectorAll(".layer:not(.difference)")].forEach((element, i) => {
      element.classList.toggle("on", i === at && !isOn("difference"));
      element.classList.toggle("same", item.buttons[i].dataset.kind === kind);
    });
    [...footer.querySelectorAll("button")].forEach((button, i) => button.setAttribute("aria-pressed", i === at));
    Object.assign(state, {open: id(item), layer: caption(item.buttons[at])});
    if (!dialog.open) dialog.showModal();
    showDifference();
    draw();
    writeFragment();
  }

  function fill(item) {
    current = item;
    stage.style.setProperty("--width", item.element.dataset.width);
    stage.style.setProperty("--height", item.element.dataset.height);
    stage.replaceChildren(...item.buttons.map(layerOf));
    footer.replaceChildren(...item.buttons.map((button, i) => {
      const choice = document.createElement("button");
      choice.type = "button";
      choice.textContent = caption(button);
      choice.addEventListener("click", () => { press("difference", false); show(item, i); });
      return choice;
    }), keyHelp());
    const comparable = item.buttons.filter(button => ["picture", "reflection"].includes(button.dataset.kind)).map(caption);
    for (const [select, first] of [[one, 2], [other, 1]]) {
      const kept = select.value;
      select.replaceChildren(...comparable.map(text => new Option(text)));
      select.value = comparable.includes(kept) ? kept : comparable[Math.min(first, comparable.length - 1)];
    }
    view.fits = true;
  }

  function layerOf(button) {
    const layer = document.createElement("div");
    layer.className = "layer";
    const label = document.createElement("span");
    label.textContent = caption(button);
    layer.append(planeOf(button), label);
    return layer;
  }

  // The embedded image is shown until the file at full size is loaded, and if it cannot be loaded.
  function planeOf(button) {
    const plane = document.createElement("div");
    plane.className = "plane";
    for (const image of button.querySelectorAll("img")) plane.append(copyOf(image.src));
    if (button.dataset.full) {
      const full = copyOf(button.dataset.full);
      full.addEventListener("error", () => { full.remove(); missing.hidden = false; });
      plane.append(full);
    }
    const region = current.buttons.find(item => item.dataset.kind === "region");
    if (region && region !== button) {
      const tint = copyOf(region.querySelector("img:last-child").src);
      tint.className = "tint";
      plane.append(tint);
    }
    return plane;
  }

  function copyOf(source) {
    const copy = new Image();
    copy.alt = "";
    copy.draggable = false;
    copy.src = source;
    return copy;
  }

  // The browser blends the two images, so that no script has to read the pixels of a file.
  function showDifference() {
    stage.querySelector(".difference")?.remove();
    for (const select of [one, other, amplification]) select.parentElement.hidden = !isOn("difference");
    const names = isOn("difference") ? [one.value, other.value] : [];
    const text = names.length ? `${names.join(" \u2212 ")}, absolute difference \u00d7 ${amplification.value}` : caption(current.buttons[at]);
    heading.textContent = `${current.name}: ${text}`;
    if (!names.length) return;
    const layer = document.createElement("div");
    layer.className = "layer on difference";
    layer.style.setProperty("--amplification", amplification.value);
    layer.append(...names.map(name => planeOf(current.buttons.find(button => caption(button) === name))));
    layer.querySelectorAll(".tint").forEach(tint => tint.remove());
    stage.append(layer);
  }

  // --- zoom and pan

  const paneAt = target => target.closest?.(".layer") ?? stage.querySelector(".layer.same, .layer.on") ?? stage;
  const limit = (value, low, high) => Math.min(Math.max(value, low), high);
  const sides = () => [Number(current.element.dataset.width), Number(current.element.dataset.height)];

  function fitZoom() {
    const pane = stage.classList.contains("all") ? stage.querySelector(".layer.same") : stage;
    const [width, height] = sides();
    return Math.min(pane.clientWidth / width, pane.clientHeight / height) || 1;
  }

  function draw() {
    stage.classList.toggle("all", isOn("all") && !isOn("difference"));
    stage.classList.toggle("tinted", isOn("region"));
    const [width, height] = sides();
    const wide = stage.clientWidth / width > stage.clientHeight / height;
    const count = stage.querySelectorAll(".layer.same").length;
    stage.style.setProperty("--columns", wide ? Math.ceil(Math.sqrt(count)) : Math.floor(Math.sqrt(count)) || 1);
    if (view.fits) Object.assign(view, {zoom: fitZoom(), x: width / 2, y: height / 2});
    Object.assign(view, {x: limit(view.x, 0, width), y: limit(view.y, 0, height)});
    for (const name of ["zoom", "x", "y"]) stage.style.setProperty(`--${name}`, view[name]);
    stage.classList.toggle("sharp", view.zoom * devicePixelRatio >= 2);
    dialog.querySelector("output").value = `${Math.round(100 * view.zoom * devicePixelRatio)} %`;
  }

  // Keeps the image point under (dx, dy), in CSS pixels from the centre of the pane.
  function zoomTo(zoom, dx = 0, dy = 0) {
    const next = limit(zoom, Math.min(fitZoom(), 1 / devicePixelRatio), 32);
    view.x += dx / view.zoom - dx / next;
    view.y += dy / view.zoom - dy / next;
    Object.assign(view, {zoom: next, fits: false});
    draw();
  }

  function fromCentre(event) {
    const box = paneAt(event.target).getBoundingClientRect();
    return [event.clientX - box.left - box.width / 2, event.clientY - box.top - box.height / 2];
  }

  stage.addEventListener("wheel", event => {
    event.preventDefault();
    zoomTo(view.zoom * 2 ** (-event.deltaY * (event.deltaMode ? 16 : 1) / 240), ...fromCentre(event));
  }, {passive: false});

  const fingers = new Map();
  let moved = 0;
  stage.addEventListener("pointerdown", event => {
    if (!fingers.size) moved = 0;
    fingers.set(event.pointerId, event);
    stage.setPointerCapture(event.pointerId);
    stage.classList.add("dragged");
  });
  stage.addEventListener("pointermove", event => {
    const last = fingers.get(event.pointerId);
    if (!last) return;
    const spread = () => { const [a, b] = [...fingers.values()]; return Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY); };
    const before = fingers.size > 1 ? spread() : 0;
    fingers.set(event.pointerId, event);
    const [dx, dy] = [event.clientX - last.clientX, event.clientY - last.clientY];
    moved += Math.hypot(dx, dy);
    if (before) return zoomTo(view.zoom * spread() / before);
    Object.assign(view, {x: view.x - dx / view.zoom, y: view.y - dy / view.zoom, fits: false});
    draw();
  });
  for (const kind of ["pointerup", "pointercancel"]) {
    stage.addEventListener(kind, event => {
      fingers.delete(event.pointerId);
      if (!fingers.size) stage.classList.remove("dragged");
    });
  }
  stage.addEventListener("click", () => { if (moved < 4 && !isOn("difference") && !isOn("all")) stepLayer(1); });
  addEventListener("resize", () => { if (dialog.open) draw(); });

  // --- keys and buttons

  const missing = document.createElement("p");
  missing.textContent = "A file at full size was not found: move the page and its files together. Its embedded image is shown.";
  missing.hidden = true;

  function keyHelp() {
    const line = document.createElement("p");
    line.textContent = "wheel or + \u2212 zoom \u00b7 drag to pan \u00b7 0 fit \u00b7 1 one to one \u00b7 \u2190 \u2192 images of one kind \u00b7 \u2191 \u2193 other cases \u00b7 "
      + "D difference \u00b7 A all methods \u00b7 R region \u00b7 Esc close";
    const lines = document.createElement("div");
    lines.append(line, missing);
    return lines;
  }

  function press(name, value = !isOn(name)) {
    toggle(name).setAttribute("aria-pressed", value);
  }

  function stepLayer(step) {
    press("difference", false);
    const kind = current.buttons[at].dataset.kind;
    const sameKind = current.buttons.flatMap((button, i) => button.dataset.kind === kind ? [i] : []);
    show(current, sameKind[(sameKind.indexOf(at) + step + sameKind.length) % sameKind.length]);
  }

  function stepCase(step) {
    const shown = visible();
    const next = shown[(shown.indexOf(current) + step + shown.length) % shown.length];
    const layer = next?.buttons.findIndex(button => caption(button) === caption(current.buttons[at]));
    if (next) show(next, Math.max(0, layer));
  }

  const actions = {
    difference: () => { press("difference"); press("all", false); show(current, at); },
    all: () => { press("all"); press("difference", false); view.fits = true; draw(); show(current, at); },
    region: () => { press("region"); draw(); },
    fit: () => { view.fits = true; draw(); },
    pixels: () => zoomTo(1 / devicePixelRatio),
    close: () => dialog.close(),
    "-1": () => stepCase(-1), 1: () => stepCase(1),
  };
  const keyActions = {
    ArrowLeft: () => stepLayer(-1), ArrowRight: () => stepLayer(1), ArrowUp: actions["-1"], ArrowDown: actions[1],
    r: actions.region, d: actions.difference, a: actions.all, 0: actions.fit, 1: actions.pixels,
    "+": () => zoomTo(2 * view.zoom), "-": () => zoomTo(view.zoom / 2),
  };
  dialog.addEventListener("keydown", event => {
    const action = keyActions[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    if (event.ctrlKey || event.metaKey || event.altKey || !action || event.target.matches("select")) return;
    event.preventDefault();
    action();
  });
  dialog.querySelector("header").addEventListener("click", event => actions[event.target.closest("button")?.value]?.());
  for (const select of [one, other, amplification]) select.addEventListener("input", showDifference);
  dialog.addEventListener("close", () => {
    Object.assign(state, {open: "", layer: ""});
    writeFragment();
    current?.buttons[at].focus();
  });

  for (const item of cases) {
    for (const button of item.buttons.filter(button => button.dataset.kind === "region")) {
      const under = item.buttons[0].querySelector("img").cloneNode();
      under.alt = "";
      under.className = "under";
      button.prepend(under);
    }
    item.buttons.forEach((button, i) => button.addEventListener("click", () => show(item, i)));
  }
  readFragment();
}
