// Keeps the photos, their edits and the settings of the page in this browser (IndexedDB), so that a reload loses none of them.
// In a private window, or without space, nothing is kept.

const STORES = ["files", "edits", "settings"];
const opened = new Promise((resolve) => {
  const request = globalThis.indexedDB?.open("brewster", 1);
  if (!request) return resolve(null);
  request.onupgradeneeded = () => STORES.forEach((name) => request.result.createObjectStore(name));
  request.onsuccess = () => resolve(request.result);
  request.onerror = () => resolve(null);
});

// Runs `work(store)` in one transaction. Resolves with the results of the requests that it returns, or with null.
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

// Keeps a photo of the queue. Its id is its place in the list.
export async function keepPhoto(photo) {
  photo.id ??= performance.timeOrigin + performance.now();
  const { id, file, burst, edits } = photo;
  photo.isKept = (await run("readwrite", (store) => [store("files").put({ file, burst }, id), store("edits").put(edits.history, id)])) !== null;
}

export const keepEdits = ({ id, edits }) => run("readwrite", (store) => [store("edits").put(edits.history, id)]);

export const keepSettings = (settings) => run("readwrite", (store) => [store("settings").put(settings, 0)]);

export const forgetPhoto = ({ id }) => run("readwrite", (store) => [store("files").delete(id), store("edits").delete(id)]);

export const forgetAll = () => run("readwrite", (store) => STORES.map((name) => store(name).clear()));

// Returns {photos: [{id, file, burst, history}], settings}, as they were kept.
export async function readSession() {
  const found = await run("readonly", (store) => [store("files").getAllKeys(), store("files").getAll(), store("edits").getAll(), store("settings").get(0)]);
  const [ids, files, histories, settings] = found ?? [[], [], []];
  return { photos: ids.map((id, index) => ({ id, ...files[index], history: histories[index] })), settings };
}
