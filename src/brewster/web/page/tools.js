// The controls for regions: the tool, its brush size, feather and strength, and undo and redo.

import { RegionEditor } from "./editor.js";

const byId = (id) => document.getElementById(id);
const chosen = (name) => document.querySelector(`input[name=${name}]:checked`).value;
const DESCRIPTIONS = {
  move: "Mark where the photo is separated, or where it stays as it is.",
  reflection: "Paint roughly over reflections that remain. The model computes the layers again.",
  scene: "Paint roughly over parts that are not reflected. The model computes the layers again.",
  here: "The marked regions are separated. If the first region is of this kind, the rest of the photo stays as it is (dark).",
  protect: "The marked regions stay as they are.",
  erase: "The eraser removes marks.",
};
const HINTS = ["reflection", "scene"];

// Creates the editor of regions and connects its controls. `onEdit()` is called when the regions of the current photo have changed,
// `onPaint()` when the view must be painted again, `saveMask()` to download the mask, and `announce(text)` to tell screen readers what
// happened.
export function createTools({ onEdit, onPaint, saveMask, announce }) {
  const number = (id) => Number(byId(id).value);
  const tool = () => ({
    shape: chosen("shape"),
    value: { here: number("region-strength"), protect: 0, reflection: 1, scene: 1 }[chosen("tool")] ?? null,
    hint: HINTS.find((hint) => hint === chosen("tool")) ?? null,
    radius: number("brush-size") / 2,
    feather: number("feather"),
  });
  const editor = new RegionEditor({
    tool,
    announce,
    onChange: onPaint,
    onAdd: (region) => edit((edits) => edits.add(region)),
  });

  function edit(work) {
    if (!editor.edits) return;
    const { list } = editor.edits;
    work(editor.edits);
    const count = editor.edits.list.length;
    if (list !== editor.edits.list) announce(count === 1 ? "1 mark" : `${count || "No"} marks`);
    onEdit();
  }

  function update() {
    const kind = chosen("tool");
    editor.isActive = kind !== "move" && editor.edits !== null;
    byId("tool-options").hidden = kind === "move";
    byId("region-strength-field").hidden = kind !== "here";
    byId("brush-size-field").hidden = chosen("shape") !== "brush";
    byId("tool-description").textContent = DESCRIPTIONS[kind];
    const { edits } = editor;
    const hasRegions = Boolean(edits?.list.length);
    const hasMask = Boolean(edits?.list.some(({ hint }) => !hint));
    for (const id of ["brush-size", "feather", "region-strength"]) byId(`${id}-amount`).textContent = `${Math.round(100 * number(id))} %`;
    byId("region-actions").hidden = kind === "move" && !hasRegions && !edits?.canUndo && !edits?.canRedo;
    const enabled = { undo: edits?.canUndo, redo: edits?.canRedo, "clear-regions": hasRegions, "save-mask": hasMask };
    for (const [id, isEnabled] of Object.entries(enabled)) byId(id).setAttribute("aria-disabled", !isEnabled);
  }

  const actions = {
    undo: () => edit((edits) => edits.undo()),
    redo: () => edit((edits) => edits.redo()),
    "clear-regions": () => edit((edits) => edits.change({ list: [] })),
    "save-mask": saveMask,
  };
  for (const [id, act] of Object.entries(actions)) {
    byId(id).addEventListener("click", () => byId(id).getAttribute("aria-disabled") === "true" || act());
  }
  for (const input of document.querySelectorAll("#regions input")) {
    input.addEventListener("input", () => (update(), onPaint()));
  }
  document.addEventListener("keydown", (event) => {
    if (!(event.ctrlKey || event.metaKey) || event.altKey || !editor.edits) return;
    const key = event.key.toLowerCase();
    if (key === "z") actions[event.shiftKey ? "redo" : "undo"]();
    else if (key === "y") actions.redo();
    else return;
    event.preventDefault();
  });
  update();

  return {
    editor,
    // Shows the tools for hints if the model takes them.
    offerHints(isOffered) {
      byId("hint-tools").hidden = !isOffered;
      if (!isOffered && HINTS.includes(chosen("tool"))) document.querySelector("input[name=tool][value=move]").checked = true;
      update();
    },
    // Shows the regions of a photo of `size` (width, height), or no regions if `edits` is null.
    show(edits, size = [1, 1]) {
      editor.cancel();
      Object.assign(editor, { edits, size });
      update();
    },
    update,
  };
}
