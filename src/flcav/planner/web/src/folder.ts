/** A folder that was dropped on the page or chosen: of a run, the few files that the planner reads. */
const WANTED = /^(results\.json|work\/[A-Za-z0-9_][A-Za-z0-9_.-]*\/errors\.parquet)$/;
const MOST_BYTES = 10e6; // uploaded in all
const MOST_ENTRIES = 400; // of a folder that are looked at

export type Folder = { name: string; files: Map<string, File> };

const read = (folder: FileSystemDirectoryReader) => new Promise<FileSystemEntry[]>((done, failed) => folder.readEntries(done, failed));
const open = (entry: FileSystemFileEntry) => new Promise<File>((done, failed) => entry.file(done, failed));

async function list(folder: FileSystemDirectoryEntry): Promise<FileSystemEntry[]> {
  const reader = folder.createReader();
  const found: FileSystemEntry[] = [];
  for (let more = await read(reader); more.length && found.length < MOST_ENTRIES; more = await read(reader)) found.push(...more);
  return found;
}

/** Return the wanted files of a dropped folder: those beside it, and in its steps. */
export async function readFolder(folder: FileSystemDirectoryEntry): Promise<Folder> {
  const files = new Map<string, File>();
  const take = async (entry: FileSystemEntry, path: string) => {
    if (entry.isFile && WANTED.test(path)) files.set(path, await open(entry as FileSystemFileEntry));
  };
  for (const entry of await list(folder)) {
    await take(entry, entry.name);
    if (entry.isDirectory && entry.name === "work")
      for (const step of await list(entry as FileSystemDirectoryEntry))
        if (step.isDirectory && step.name.includes("-errors-")) for (const each of await list(step as FileSystemDirectoryEntry)) await take(each, `work/${step.name}/${each.name}`);
  }
  return { name: folder.name, files };
}

/** Return the wanted files of a folder that was chosen in a file dialogue. */
export function chosenFolder(chosen: FileList): Folder {
  const files = new Map<string, File>();
  for (const file of chosen) {
    const path = file.webkitRelativePath.split("/").slice(1).join("/");
    if (WANTED.test(path)) files.set(path, file);
  }
  return { name: chosen[0]?.webkitRelativePath.split("/")[0] ?? "", files };
}

/** Return the files as base64, or throw the sentence that says what to do instead. */
export async function packFolder({ name, files }: Folder): Promise<Record<string, string>> {
  const how = `flcav planner ${name || "FOLDER"}, on the command line, opens it`;
  if (!files.has("results.json")) throw new Error(`${name} is no folder of a finished run: it has no results.json. A folder with a town: ${how}.`);
  if ([...files.values()].reduce((sum, file) => sum + file.size, 0) > MOST_BYTES) throw new Error(`${name} has too much to be uploaded: ${how}.`);
  const packed: Record<string, string> = {};
  for (const [path, file] of files) {
    const bytes = new Uint8Array(await file.arrayBuffer());
    let text = "";
    for (let n = 0; n < bytes.length; n += 0x8000) text += String.fromCharCode(...bytes.subarray(n, n + 0x8000));
    packed[path] = btoa(text);
  }
  return packed;
}
