// Keeps the photos, their edits and results, and the settings of the page in this browser
// (IndexedDB), so that a reload loses none of them. In a private window, or without space, nothing
// is kept.

const STORES = ["files", "edits", "settings", "records"];
const VERSION = 5; // of the stores; one more whenever they change
const SETTINGS_KEY = 0;
const SHOWN_KEY = 1;
const MAX_RESULT_BYTES = 300e6; // of all kept results
// the sizes of the kept results by the id of their photo, the oldest first
const resultBytes = new Map();

const opened = new Promise((resolve) => {
  const request = globalThis.indexedDB?.open("brewster", VERSION);
  if (!request) return resolve(null);
  request.onupgradeneeded = () => {
    const { result } = request;
    for (const name of [...result.objectStoreNames])
      if (!STORES.includes(name)) result.deleteObjectStore(name);
    for (const name of STORES)
      if (!result.objectStoreNames.contains(name)) result.createObjectStore(name);
  };
  request.onsuccess = () => {
    request.result.onversionchange = () => request.result.close();
    resolve(request.result);
  };
  request.onerror = () => resolve(null);
  request.onblocked = () => resolve(null);
});

// Runs `work(store)` in one transaction. Resolves with the results of the requests that it returns,
// or with null.
async function run(mode, work) {
  const database = await opened;
  if (!database) return null;
  return new Promise((resolve) => {
    const transaction = database.transaction(STORES, mode);
    const requests = work((name) => transaction.objectStore(name));
    transaction.oncomplete = () => resolve(requests.map(({ result }) => result));
    transaction.onabort = () => resolve(null);
  });
}

// Keeps a photo of the queue, with its result if it has one. Its id is its place in the list.
export async function keepPhoto(photo) {
  photo.id ??= performance.timeOrigin + performance.now();
  const { id, file, burst, film, edits } = photo;
  photo.isKept =
    (await run("readwrite", (store) => [
      store("files").put({ file, burst, film }, id),
      store("edits").put(edits.history, id),
    ])) !== null;
  if (photo.state === "done") await keepResult(photo);
}

// Keeps the result of a photo. If the results need too much space, the oldest are dropped: their
// photos are separated again after a reload.
export function keepResult({ id, preview, result, upload, size, takesHints, model, mapSettings }) {
  resultBytes.delete(id);
  resultBytes.set(id, preview.size);
  const dropped = oldestResults();
  return run("readwrite", (store) => [
    store("records").put({ preview, result, upload, size, takesHints, model, mapSettings }, id),
    ...dropped.map((old) => store("records").delete(old)),
  ]);
}

function oldestResults() {
  const dropped = [];
  let bytes = [...resultBytes.values()].reduce((sum, size) => sum + size, 0);
  for (const [id, size] of resultBytes) {
    if (bytes <= MAX_RESULT_BYTES) break;
    bytes -= size;
    resultBytes.delete(id);
    dropped.push(id);
  }
  return dropped;
}

export const keepEdits = ({ id, edits }) =>
  run("readwrite", (store) => [store("edits").put(edits.history, id)]);

export const keepSettings = (settings) =>
  run("readwrite", (store) => [store("settings").put(settings, SETTINGS_KEY)]);

// Keeps which photo is shown.
export const keepShown = ({ id }) =>
  run("readwrite", (store) => [store("settings").put(id, SHOWN_KEY)]);

export function forgetPhoto({ id }) {
  resultBytes.delete(id);
  return run("readwrite", (store) =>
    ["files", "edits", "records"].map((name) => store(name).delete(id)),
  );
}

export function forgetAll() {
  resultBytes.clear();
  return run("readwrite", (store) => STORES.map((name) => store(name).clear()));
}

// Returns {photos: [{id, file, burst, film, history, result}], settings, shownId}, as they were
// kept.
export async function readSession() {
  const found = await run("readonly", (store) => [
    store("files").getAllKeys(),
    store("files").getAll(),
    store("edits").getAll(),
    store("records").getAllKeys(),
    store("records").getAll(),
    store("settings").get(SETTINGS_KEY),
    store("settings").get(SHOWN_KEY),
  ]);
  const [ids, files, histories, resultIds, results, settings, shownId] = found ?? [
    [],
    [],
    [],
    [],
    [],
  ];
  const resultOf = new Map(resultIds.map((id, index) => [id, results[index]]));
  for (const [id, { preview }] of resultOf) resultBytes.set(id, preview.size);
  const photos = ids.map((id, index) => ({
    id,
    ...files[index],
    history: histories[index],
    result: resultOf.get(id),
  }));
  return { photos, settings, shownId };
}
