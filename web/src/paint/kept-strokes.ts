/**
 * Strokes that wait, kept in the browser so that they outlive a reload of the page. Each belongs to the page that drew it,
 * until that page is gone: then another page of the same studio takes it over, one of them only.
 */

import type { PaintBegin, PaintLimits, Symmetry } from "../messages";
import type { LeftProject, Method } from "../state/store";
import type { CameraJson } from "../view/camera";
import type { Rect } from "./raster";
import type { StrokeTarget } from "./stroke";

/** Everything that a stroke is, when its pen is up. */
export interface KeptStroke {
  /** Of the record. */
  id: string;
  /** The page that answers for it. */
  page: string;
  /** Milliseconds since 1970: they are painted in this order. */
  drawn: number;
  project: LeftProject;
  camera: CameraJson;
  kind: NonNullable<PaintBegin["kind"]>;
  layer: string | null;
  name: string;
  target: StrokeTarget;
  method: Method;
  limits: PaintLimits;
  mirror: Symmetry | null;
  /** As `Stroke.committing`. */
  committing: number | null;
  rect: Rect;
  /** RGBA of the rectangle, straight alpha, inside of what was selected. */
  rgba: Uint8ClampedArray<ArrayBuffer>;
}

/** Where they are kept: the browser's database; tests have one of their own. */
export interface Shelf {
  put(stroke: KeptStroke): Promise<void>;
  delete(id: string): Promise<void>;
  all(): Promise<KeptStroke[]>;
  /** Make all strokes of one page another one's; those that were. In one step: of two pages only one gets them. */
  take(from: string, to: string): Promise<KeptStroke[]>;
}

/** Pages that are alive hold a lock of their name; null where the browser has none (pages that are not secure). */
export type Locks = Pick<LockManager, "request"> | null;

const LOCK = "splatpainter page ";
const PAGE_KEY = "splatpainter.page";

export class KeptStrokes {
  constructor(
    private readonly shelf: Shelf = new BrowserShelf(),
    private readonly locks: Locks = navigator.locks ?? null,
    private readonly page = locks ? crypto.randomUUID() : pageOfTab(),
  ) {
    void locks?.request(LOCK + page, () => new Promise(() => {})); // until this page is gone
  }

  /** Keep a stroke, or what is new of it. Where the browser keeps nothing it lives as long as the page. */
  async keep(stroke: Omit<KeptStroke, "page">): Promise<boolean> {
    try {
      await this.shelf.put({ ...stroke, page: this.page });
      return true;
    } catch {
      return false; // no database: private windows of some browsers; or no room
    }
  }

  async drop(id: string): Promise<void> {
    await this.shelf.delete(id).catch(() => {});
  }

  /** Take over what pages that are gone have left, now and whenever another one goes. `restore`: in drawing order. */
  async takeOver(restore: (strokes: KeptStroke[]) => void): Promise<void> {
    const all = await this.shelf.all().catch(() => []);
    const take = async (page: string) => {
      const strokes = await this.shelf.take(page, this.page).catch(() => []);
      if (strokes.length) restore(strokes.sort((a, b) => a.drawn - b.drawn));
    };
    if (!this.locks) return take(this.page); // those of this tab, from before the reload
    for (const page of new Set(all.map((one) => one.page)))
      if (page !== this.page) void this.locks.request(LOCK + page, () => take(page));
  }
}

/** A name for this tab that a reload does not change. */
function pageOfTab(): string {
  const before = sessionStorage.getItem(PAGE_KEY);
  const name = before ?? Array.from(crypto.getRandomValues(new Uint32Array(4)), (word) => word.toString(16)).join("");
  if (!before) sessionStorage.setItem(PAGE_KEY, name);
  return name;
}

const STORE = "strokes";

/** The browser's database of this studio's address. */
class BrowserShelf implements Shelf {
  private opened: Promise<IDBDatabase> | null = null;

  async put(stroke: KeptStroke): Promise<void> {
    const store = await this.store("readwrite");
    await finished(store.put(stroke));
  }

  async delete(id: string): Promise<void> {
    const store = await this.store("readwrite");
    await finished(store.delete(id));
  }

  async all(): Promise<KeptStroke[]> {
    const store = await this.store("readonly");
    return (await finished(store.getAll())) as KeptStroke[];
  }

  async take(from: string, to: string): Promise<KeptStroke[]> {
    const store = await this.store("readwrite");
    const all = (await finished(store.getAll())) as KeptStroke[];
    const strokes = all.filter(({ page }) => page === from).map((one) => ({ ...one, page: to }));
    for (const one of strokes) store.put(one);
    return strokes;
  }

  private async store(mode: IDBTransactionMode): Promise<IDBObjectStore> {
    this.opened ??= open();
    this.opened.catch(() => (this.opened = null));
    return (await this.opened).transaction(STORE, mode).objectStore(STORE);
  }
}

function open(): Promise<IDBDatabase> {
  const request = indexedDB.open("splatpainter", 1);
  request.onupgradeneeded = () => request.result.createObjectStore(STORE, { keyPath: "id" });
  return finished(request);
}

function finished<T>(request: IDBRequest<T>): Promise<T> {
  return new Promise((resolve, reject) => {
    request.onsuccess = () => resolve(request.result);
    request.onerror = () => reject(request.error ?? new Error("the browser's database did not answer"));
  });
}
