// The filter of the cases and the comparison of two images in the HTML report.
//
// biome-ignore lint/suspicious/noRedundantUseStrict: the report contains this as a classic script
"use strict";
{
  const form = document.getElementById("filter");
  const list = document.getElementById("cases");
  const dialog = document.querySelector("dialog");
  const cases = [...list.querySelectorAll("article")].map((element) => ({
    element,
    scores: JSON.parse(element.dataset.scores),
  }));

  // --- sort and filter

  function value(scores) {
    const { metric, method, by } = form.elements;
    const score = scores[method.value]?.[metric.value];
    const baseline = by.value === "difference" ? scores[form.dataset.baseline]?.[metric.value] : 0;
    return score == null || baseline == null ? null : score - baseline;
  }

  function update() {
    const { metric, order, benchmark, text } = form.elements;
    const direction = (metric.selectedOptions[0]?.dataset.sign ?? 1) * order.value;
    for (const item of cases) item.value = value(item.scores);
    cases.sort(({ value: a }, { value: b }) => (a === null) - (b === null) || direction * (a - b));
    list.append(...cases.map((item) => item.element));
    for (const { element } of cases) {
      const isInBenchmark = !benchmark.value || element.dataset.benchmark === benchmark.value;
      element.hidden = !(
        isInBenchmark && element.dataset.name.toLowerCase().includes(text.value.toLowerCase())
      );
    }
    form.querySelector("output").value =
      `${cases.filter((item) => !item.element.hidden).length} of ${cases.length} images`;
  }

  form.addEventListener("input", update);
  form.addEventListener("submit", (event) => event.preventDefault());
  update();

  // --- before and after: the clicked image, and left of the line another image of the same photo

  const [after, before] = dialog.querySelectorAll("img");
  const other = dialog.querySelector("select");
  const caption = (figure) => figure.querySelector("figcaption").textContent;

  function show(image, figure) {
    const embedded = figure.querySelector("img").src;
    // if the file at full size is not found
    image.onerror = () => {
      image.onerror = null;
      image.src = embedded;
    };
    image.src = figure.querySelector("a")?.href ?? embedded;
  }

  list.addEventListener("click", (event) => {
    const clicked = event.target.closest("button")?.parentElement;
    if (!clicked) return;
    const article = clicked.closest("article");
    const figures = [...article.querySelectorAll("figure")];
    other.replaceChildren(...figures.map((figure, i) => new Option(caption(figure), i)));
    other.oninput = () => show(before, figures[other.value]);
    other.oninput();
    show(after, clicked);
    dialog.querySelector("h2").textContent = `${article.dataset.name}: ${caption(clicked)}`;
    dialog.showModal();
  });
  dialog
    .querySelector("input")
    .addEventListener("input", (event) =>
      dialog.style.setProperty("--split", `${event.target.value}%`),
    );
}
