// Downloads at full size, with the same files as on the command line, and the report in the zip of
// all photos.

import { send } from "./api.js";
import { burstOptions, isMeasured } from "./queue.js";
import { hintsFile, maskFile } from "./marks.js";
import { verdictOf } from "./verdict.js";
import { createZip, crc32, readZip, withUniqueNames } from "./zip.js";

const REPORT_NAME = "brewster-report.txt";

// Requests layers of a photo at full size. Returns the result of `send`.
async function requestLayers(photo, layers, { takesHints, ...settings }, context) {
  const { list, strength } = photo.edits;
  const mask = await maskFile(list, ...photo.size);
  const hints = takesHints && !isMeasured(photo) ? await hintsFile(list, ...photo.size) : null;
  const options = { layers, strength, mask, hints, ...settings, ...burstOptions(photo) };
  return send("separate", photo, options, context);
}

// Creates one layer of a photo. Returns {name, blob, problem, saved}, where `saved` are the photos
// whose results the file contains.
export async function exportLayer(photo, layer, settings, context) {
  const { blob, fileName } = await requestLayers(photo, layer, settings, context);
  return { name: fileName, blob, problem: "", saved: [photo] };
}

// Creates a zip of these layers of all photos that are done, with a report that also lists the
// photos that failed. A photo that fails during the export is left out, and `problem` describes the
// error. `onPhoto(index, count)` is called before each photo.
//
// Throws an Error if all photos fail.
export async function exportAll(photos, layers, settings, { onPhoto, ...context }) {
  const results = photos.map((photo) => ({
    photo,
    files: [],
    error: photo.state === "failed" ? problemOf(photo) : null,
  }));
  const separated = results.filter(({ photo }) => photo.state === "done");
  for (const [index, result] of separated.entries()) {
    onPhoto(index, separated.length);
    try {
      const { blob, fileName } = await requestLayers(
        result.photo,
        layers.join(),
        settings,
        context,
      );
      const data = await blob.arrayBuffer();
      result.files =
        layers.length > 1
          ? readZip(data)
          : [{ name: fileName, crc: crc32(new Uint8Array(data)), data }];
    } catch (error) {
      if (error.name === "AbortError") throw error;
      result.error = problemOf({ error });
    }
  }
  const failed = separated.filter(({ error }) => error);
  const doneCount = separated.length - failed.length;
  const problem = [
    ...(doneCount < results.length
      ? [`${doneCount} of ${results.length} photos are in the zip.`]
      : []),
    ...failed.map(({ photo, error }) => `${photo.file.name} is not in the zip. ${error}`),
  ].join(" ");
  if (failed.length === separated.length) throw new Error(problem);
  const files = withUniqueNames(results.flatMap((result) => result.files));
  const report = new TextEncoder().encode(describeResults(results, files, settings));
  const blob = createZip([...files, { name: REPORT_NAME, crc: crc32(report), data: report }]);
  return {
    name: "brewster.zip",
    blob,
    problem,
    saved: separated.filter(({ error }) => !error).map(({ photo }) => photo),
  };
}

const problemOf = ({ error }) =>
  error ? `${error.message} ${error.details ?? ""}`.trim() : "It was cancelled.";

// Returns the text of the report. `files` are the files of all results in this order, with their
// names in the zip.
function describeResults(results, files, { model, quality }) {
  const names = files.map(({ name }) => name);
  const lines = results.map(({ photo, files: own, error }) => {
    if (!own.length)
      return `${photo.file.name}: ${error ? `failed. ${error}` : "not separated yet"}`;
    const { list, strength, swap } = photo.edits.now;
    const facts = [verdictOf(photo), `strength ${Math.round(100 * strength)} %`];
    if (list.length) facts.push("with marks");
    if (swap) facts.push("layers exchanged");
    const message = photo.result.burst ? `. ${photo.result.burst.message}` : "";
    const written = names.splice(0, own.length).join(", ");
    return `${photo.file.name} -> ${written} (${facts.join(", ")})${message}`;
  });
  const done = results.filter((result) => result.files.length).length;
  const counts = `${done} done, ${results.filter(({ error }) => error).length} failed`;
  return [`brewster, model ${model}, quality ${quality}: ${counts}`, "", ...lines, ""].join("\n");
}

// Lets the browser save a file.
export function save(name, blob) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60_000);
}
