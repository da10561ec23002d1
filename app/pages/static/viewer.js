// Before and after in one view that pans and zooms freely: split, side by side, one alone, or held.

import { Tiles } from "./tiles.js";

const MOST_ZOOM = 8;
const STEP = 1.25;

export class Viewer {
  constructor(root) {
    this.root = root;
    this.stage = root.querySelector(".stage");
    this.canvas = root.querySelector("canvas");
    this.handle = root.querySelector(".handle");
    this.words = root.querySelector(".zoom-words");
    this.width = Number(root.dataset.width);
    this.height = Number(root.dataset.height);
    this.mode = root.dataset.after ? "split" : "before";
    this.split = 0.5;
    this.held = false;
    this.patches = []; // pictures of parts, drawn over the corrected photo: {x, y, width, height, image}
    this.overlay = null; // draws over the corrected photo in photo pixels
    this.listeners = new Set();
    this.waiting = false;
    const redraw = () => this.redraw();
    this.before = new Tiles(root.dataset.before, this.width, this.height, redraw);
    this.after = root.dataset.after ? new Tiles(root.dataset.after, this.width, this.height, redraw) : null;
    this.view = { x: this.width / 2, y: this.height / 2, scale: 0 };
    this.pointers = new Map();
    this.listen();
    new ResizeObserver(() => this.resized()).observe(this.stage);
  }

  get ratio() {
    return window.devicePixelRatio || 1;
  }

  get shown() {
    return this.held ? "before" : this.mode;
  }

  get hasAfter() {
    return this.after !== null || this.patches.length > 0;
  }

  get panes() {
    const box = { x: 0, y: 0, width: this.stage.clientWidth, height: this.stage.clientHeight };
    if (this.shown !== "side") return [box];
    if (box.width >= box.height) {
      const half = box.width / 2;
      return [{ ...box, width: half - 1 }, { ...box, x: half + 1, width: half - 1 }];
    }
    const half = box.height / 2; // a phone held upright: one above the other
    return [{ ...box, height: half - 1 }, { ...box, y: half + 1, height: half - 1 }];
  }

  get fitting() {
    const [pane] = this.panes;
    return Math.min(pane.width / this.width, pane.height / this.height);
  }

  resized() {
    const { clientWidth, clientHeight } = this.stage;
    if (!clientWidth || !clientHeight) return;
    const first = this.view.scale === 0;
    const fitted = this.fitted;
    this.canvas.width = Math.round(clientWidth * this.ratio);
    this.canvas.height = Math.round(clientHeight * this.ratio);
    if (first && this.fromAddress()) return;
    if (first || fitted) this.fit();
    else this.changed();
  }

  fit() {
    this.fitted = true;
    this.set(this.width / 2, this.height / 2, this.fitting);
  }

  // Go to a place in photo pixels, one of its pixels to one of the screen's.
  goTo(x, y, scale = 1 / this.ratio) {
    this.fitted = false;
    this.set(x, y, scale);
  }

  set(x, y, scale) {
    const least = Math.min(this.fitting, 1 / this.ratio);
    const bounded = Math.min(MOST_ZOOM / this.ratio, Math.max(least, scale));
    const [pane] = this.panes;
    const hold = (at, size, room) => {
      const half = room / bounded / 2;
      return half * 2 >= size ? size / 2 : Math.min(size - half, Math.max(half, at));
    };
    this.view = { x: hold(x, this.width, pane.width), y: hold(y, this.height, pane.height), scale: bounded };
    this.changed();
  }

  // Zoom by a factor so that the photo under a point of the stage stays there.
  zoom(factor, at) {
    const pane = this.paneAt(at);
    const { x, y, scale } = this.view;
    const [dx, dy] = at ? [at.x - pane.x - pane.width / 2, at.y - pane.y - pane.height / 2] : [0, 0];
    const least = Math.min(this.fitting, 1 / this.ratio);
    const next = Math.min(MOST_ZOOM / this.ratio, Math.max(least, scale * factor));
    this.fitted = false;
    this.set(x + dx / scale - dx / next, y + dy / scale - dy / next, next);
  }

  pan(dx, dy) {
    this.fitted = false;
    this.set(this.view.x - dx / this.view.scale, this.view.y - dy / this.view.scale, this.view.scale);
  }

  paneAt(at) {
    const panes = this.panes;
    const within = (pane) =>
      at && at.x >= pane.x && at.x < pane.x + pane.width && at.y >= pane.y && at.y < pane.y + pane.height;
    return panes.find(within) ?? panes[0];
  }

  // The part of the photo that is seen, in whole photo pixels.
  get region() {
    const [pane] = this.panes;
    const { x, y, scale } = this.view;
    const [halfX, halfY] = [pane.width / scale / 2, pane.height / scale / 2];
    const left = Math.max(0, Math.floor(x - halfX));
    const top = Math.max(0, Math.floor(y - halfY));
    const right = Math.min(this.width, Math.ceil(x + halfX));
    const bottom = Math.min(this.height, Math.ceil(y + halfY));
    return { x: left, y: top, width: right - left, height: bottom - top };
  }

  setMode(mode) {
    this.mode = mode;
    if (this.fitted) this.fit();
    this.changed();
  }

  hold(on) {
    if (this.held === on) return;
    this.held = on;
    this.changed();
  }

  onChange(listener) {
    this.listeners.add(listener);
  }

  changed() {
    this.handle.hidden = !this.hasAfter || this.shown !== "split"; // at once: the next key may be meant for it
    this.redraw();
    const percent = Math.round(this.view.scale * this.ratio * 100);
    this.words.textContent = `${percent} %`;
    for (const listener of this.listeners) listener(this);
    clearTimeout(this.noting);
    this.noting = setTimeout(() => {
      const { x, y, scale } = this.view;
      const at = this.fitted ? "" : `#at=${Math.round(x)},${Math.round(y)},${(scale * this.ratio).toFixed(2)}`;
      history.replaceState(null, "", `${location.pathname}${location.search}${at}`);
    }, 300);
  }

  fromAddress() {
    const match = /^#at=(\d+),(\d+),([\d.]+)$/.exec(location.hash);
    if (!match) return false;
    this.goTo(Number(match[1]), Number(match[2]), Number(match[3]) / this.ratio);
    return true;
  }

  redraw() {
    if (this.waiting) return;
    this.waiting = true;
    this.canvas.setAttribute("aria-busy", "true");
    requestAnimationFrame(() => {
      this.waiting = false;
      this.draw();
    });
  }

  draw() {
    const context = this.canvas.getContext("2d");
    const { ratio } = this;
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, this.canvas.width, this.canvas.height);
    const shown = this.hasAfter ? this.shown : "before";
    const panes = this.panes;
    const pictures = [this.before, this.after].filter(Boolean);
    for (const tiles of pictures) tiles.loading = false;
    const split = shown === "split";
    if (split) {
      const [pane] = panes;
      const at = pane.width * this.split;
      this.drawPane(context, pane, "before", { ...pane, width: at });
      this.drawPane(context, pane, "after", { ...pane, x: at, width: pane.width - at });
      this.handle.style.left = `${at}px`;
    } else if (shown === "side") {
      this.drawPane(context, panes[0], "before", panes[0]);
      this.drawPane(context, panes[1], "after", panes[1]);
    } else this.drawPane(context, panes[0], shown, panes[0]);
    this.handle.hidden = !split;
    this.root.dataset.shown = shown;
    this.root.classList.toggle("stacked", shown === "side" && panes[1].y > 0);
    this.canvas.setAttribute("aria-busy", String(pictures.some(({ loading }) => loading)));
  }

  drawPane(context, pane, which, clip) {
    context.save();
    context.beginPath();
    context.rect(clip.x, clip.y, clip.width, clip.height);
    context.clip();
    const tiles = which === "after" && this.after ? this.after : this.before;
    tiles.draw(context, this.view, pane, this.ratio);
    if (which === "after") {
      context.translate(pane.x + pane.width / 2 - this.view.x * this.view.scale, pane.y + pane.height / 2 - this.view.y * this.view.scale);
      context.scale(this.view.scale, this.view.scale);
      for (const { image, x, y, width, height } of this.patches) context.drawImage(image, x, y, width, height);
      this.overlay?.(context, this.view.scale);
    }
    context.restore();
  }

  listen() {
    const { stage, handle } = this;
    const at = (event) => {
      const box = stage.getBoundingClientRect();
      return { x: event.clientX - box.left, y: event.clientY - box.top };
    };
    stage.addEventListener("pointerdown", (event) => {
      if (event.target === handle || event.button > 0) return;
      stage.setPointerCapture(event.pointerId);
      this.pointers.set(event.pointerId, at(event));
    });
    stage.addEventListener("pointermove", (event) => {
      const before = this.pointers.get(event.pointerId);
      if (!before) return;
      const now = at(event);
      const others = [...this.pointers].filter(([id]) => id !== event.pointerId).map(([, point]) => point);
      if (others.length === 1) {
        const [other] = others;
        const apart = (point) => Math.max(8, Math.hypot(point.x - other.x, point.y - other.y));
        this.zoom(apart(now) / apart(before), { x: (now.x + other.x) / 2, y: (now.y + other.y) / 2 });
        this.pan((now.x - before.x) / 2, (now.y - before.y) / 2);
      } else this.pan(now.x - before.x, now.y - before.y);
      this.pointers.set(event.pointerId, now);
    });
    for (const kind of ["pointerup", "pointercancel"])
      stage.addEventListener(kind, (event) => this.pointers.delete(event.pointerId));
    stage.addEventListener(
      "wheel",
      (event) => {
        event.preventDefault();
        this.zoom(STEP ** (-Math.sign(event.deltaY) * Math.min(2, Math.abs(event.deltaY) / 60 + 0.4)), at(event));
      },
      { passive: false },
    );
    stage.addEventListener("dblclick", (event) => {
      if (this.view.scale * this.ratio > 0.99) this.fit();
      else this.zoom(1 / this.ratio / this.view.scale, at(event));
    });
    const moveSplit = (share) => {
      this.split = Math.min(0.98, Math.max(0.02, share));
      handle.setAttribute("aria-valuenow", String(Math.round(this.split * 100)));
      this.redraw();
    };
    handle.addEventListener("pointerdown", (event) => {
      event.stopPropagation();
      handle.setPointerCapture(event.pointerId);
    });
    handle.addEventListener("pointermove", (event) => {
      if (handle.hasPointerCapture(event.pointerId)) moveSplit(at(event).x / stage.clientWidth);
    });
    handle.addEventListener("keydown", (event) => {
      const step = { ArrowLeft: -0.02, ArrowRight: 0.02, ArrowDown: -0.02, ArrowUp: 0.02 }[event.key];
      if (step === undefined) return;
      event.preventDefault();
      event.stopPropagation();
      moveSplit(this.split + step);
    });
    this.canvas.addEventListener("keydown", (event) => this.key(event));
  }

  key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const far = Math.min(this.stage.clientWidth, this.stage.clientHeight) / 5;
    const acts = {
      ArrowLeft: () => this.pan(far, 0),
      ArrowRight: () => this.pan(-far, 0),
      ArrowUp: () => this.pan(0, far),
      ArrowDown: () => this.pan(0, -far),
      "+": () => this.zoom(STEP),
      "=": () => this.zoom(STEP),
      "-": () => this.zoom(1 / STEP),
      0: () => this.fit(),
      1: () => this.goTo(this.view.x, this.view.y),
    };
    if (!acts[event.key]) return;
    event.preventDefault();
    acts[event.key]();
  }
}
