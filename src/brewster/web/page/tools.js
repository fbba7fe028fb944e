// The controls for marks: the tool, its brush size and feather, and undo and redo of all edits.

import { announce, byId, chosen, isEnabled } from "./dom.js";
import { MarkEditor } from "./editor.js";

const DESCRIPTIONS = {
  move: "Is something wrong? Choose a mark, and paint on the photo.",
  reflection:
    "Paint roughly over a reflection that remains. When you stop painting, the photo is " +
    "separated again.",
  scene: "Paint roughly over things behind the glass that were taken for a reflection.",
  protect: "What you mark stays exactly as it is in the photo.",
  erase: "Removes marks. All marks are shown.",
};
const HINTS = ["reflection", "scene"];

// Creates the editor of marks and connects its controls. `onEdit()` is called when the edits of the
// current photo have changed, `onUndo()` and `onRedo()` to step through their history,
// `onMarking(isMarking)` when a tool for marks is chosen or none, `onMarkStart()` when a mark
// begins, `onPaint()` when the view must be painted again, and `onCopyMarks()` and `saveMarks()` to
// copy the marks to all photos and to download them.
export function createTools({
  onEdit,
  onUndo,
  onRedo,
  onCopyMarks,
  onMarkStart,
  onMarking,
  onPaint,
  saveMarks,
}) {
  const number = (id) => Number(byId(id).value);
  const tool = () => ({
    shape: chosen("shape"),
    kind: chosen("tool"),
    radius: number("brush-size") / 2,
    feather: HINTS.includes(chosen("tool")) ? 0 : number("feather"),
  });
  const editor = new MarkEditor({
    tool,
    announce,
    onChange: onPaint,
    onStart: onMarkStart,
    onAdd: (mark) => edit((edits) => edits.add(mark)),
  });

  function edit(work) {
    if (!editor.edits) return;
    countMarks(() => {
      work(editor.edits);
      onEdit();
    });
  }

  // Does a change, and announces the number of marks if it is another one.
  function countMarks(change) {
    const { list } = editor.edits;
    change();
    const count = editor.edits.list.length;
    if (list !== editor.edits.list) announce(count === 1 ? "1 mark" : `${count || "No"} marks`);
  }

  function update() {
    const kind = chosen("tool");
    const isMarking = kind !== "move" && editor.edits !== null;
    if (isMarking !== editor.isActive) {
      editor.isActive = isMarking;
      onMarking(isMarking);
    }
    byId("tool-options").hidden = kind === "move";
    byId("feather-field").hidden = HINTS.includes(kind);
    byId("brush-size-field").hidden = chosen("shape") !== "brush";
    byId("tool-description").textContent = DESCRIPTIONS[kind];
    const { edits } = editor;
    const hasMarks = Boolean(edits?.list.length);
    for (const id of ["brush-size", "feather"])
      byId(`${id}-amount`).textContent = `${Math.round(100 * number(id))} %`;
    byId("mark-actions").hidden =
      kind === "move" && !hasMarks && !edits?.canUndo && !edits?.canRedo;
    const enabled = {
      undo: edits?.canUndo,
      redo: edits?.canRedo,
      "clear-marks": hasMarks,
      "save-marks": hasMarks,
      "copy-marks": hasMarks,
    };
    for (const [id, isEnabled] of Object.entries(enabled))
      byId(id).setAttribute("aria-disabled", !isEnabled);
  }

  const actions = {
    undo: () => countMarks(onUndo),
    redo: () => countMarks(onRedo),
    "clear-marks": () => edit((edits) => edits.change({ list: [] })),
    "save-marks": saveMarks,
    "copy-marks": onCopyMarks,
  };
  for (const [id, act] of Object.entries(actions)) {
    byId(id).addEventListener("click", () => isEnabled(byId(id)) && act());
  }
  for (const input of document.querySelectorAll("#marks input")) {
    input.addEventListener("input", () => {
      update();
      onPaint();
    });
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
      for (const hint of HINTS) byId(`tool-${hint}`).hidden = !isOffered;
      if (!isOffered && HINTS.includes(chosen("tool")))
        document.querySelector("input[name=tool][value=move]").checked = true;
      update();
    },
    // Shows the marks of a photo of `size` (width, height), or no marks if `edits` is null.
    show(edits, size = [1, 1]) {
      editor.cancel();
      Object.assign(editor, { edits, size });
      update();
    },
    update,
  };
}
