// Before and after in two views of OpenSeadragon that move as one: split, side by side, one alone, or held.

import { byId } from "./common.js";

const TILE = 512; // as the service cuts pictures
const CLOSEST = 8; // pixels of the screen for one of the photo

const ratio = () => window.devicePixelRatio || 1;

export class Viewer {
  constructor(root) {
    this.root = root;
    this.stage = root.querySelector(".stage");
    [this.width, this.height] = [Number(root.dataset.width), Number(root.dataset.height)];
    this.hasAfter = Boolean(root.dataset.after);
    this.fitted = true;
    this.listeners = new Set();
    const { before, after = before } = root.dataset;
    this.panes = [this.open(".pane.before", before), this.open(".pane.after", after)];
    [this.leader] = this.panes; // the one that is moved: the other follows
    this.setMode(this.hasAfter ? "split" : "before");
  }

  open(place, base) {
    const maxLevel = Math.max(0, Math.ceil(Math.log2(Math.max(this.width, this.height) / TILE)));
    const pane = window.OpenSeadragon({
      element: this.stage.querySelector(place),
      tileSources: { width: this.width, height: this.height, tileSize: TILE, maxLevel, getTileUrl: (level, col, row) => `${base}/${maxLevel - level}/${col}_${row}.jpg` },
      drawer: "canvas",
      showNavigationControl: false,
      keyboardNavEnabled: false, // the stage listens to keys
      tabIndex: -1,
      animationTime: matchMedia("(prefers-reduced-motion: reduce)").matches ? 0 : 0.3,
      visibilityRatio: 1,
      constrainDuringPan: true,
      maxZoomPixelRatio: CLOSEST / ratio(),
      preserveImageSizeOnResize: true,
      gestureSettingsMouse: { clickToZoom: false, dblClickToZoom: true },
    });
    pane.element.addEventListener("pointerdown", () => (this.leader = pane), { capture: true });
    pane.element.addEventListener("wheel", () => (this.leader = pane), { capture: true, passive: true });
    pane.addHandler("open", () => this.bound(pane) || (pane === this.leader && this.fromAddress()));
    pane.addHandler("resize", () => this.bound(pane) || (pane === this.leader && (this.refit = this.fitted))); // whole stays whole
    pane.addHandler("viewport-change", () => this.moved(pane));
    pane.addHandler("fully-loaded-change", () => this.loaded());
    return pane;
  }

  // A photo that is smaller than the stage is seen pixel by pixel too.
  bound({ viewport }) {
    viewport.minZoomLevel = Math.min(viewport.getHomeZoom(), viewport.imageToViewportZoom(1 / ratio()));
  }

  loaded() {
    const ready = this.panes.every((pane) => pane.world.getItemAt(0)?.getFullyLoaded());
    this.stage.setAttribute("aria-busy", String(!ready));
  }

  get viewport() {
    return this.leader.viewport;
  }

  get centre() {
    return this.viewport.viewportToImageCoordinates(this.viewport.getCenter());
  }

  // The part of the photo that is seen, in whole photo pixels.
  get region() {
    const { x, y, width, height } = this.viewport.viewportToImageRectangle(this.viewport.getBounds());
    const [left, top] = [Math.max(0, Math.floor(x)), Math.max(0, Math.floor(y))];
    return { x: left, y: top, width: Math.min(this.width, Math.ceil(x + width)) - left, height: Math.min(this.height, Math.ceil(y + height)) - top };
  }

  fit() {
    this.refit = false;
    this.viewport.goHome(true);
  }

  // Go to a place in photo pixels, one of its pixels to one of the screen's.
  goTo(x, y, zoom = 1) {
    this.viewport.zoomTo(this.viewport.imageToViewportZoom(zoom / ratio()), null, true);
    this.viewport.panTo(this.viewport.imageToViewportCoordinates(x, y), true);
    this.viewport.applyConstraints(true);
  }

  zoom(factor) {
    this.viewport.zoomBy(factor).applyConstraints();
  }

  pan(x, y) {
    const far = Math.min(this.stage.clientWidth, this.stage.clientHeight) / 5;
    this.viewport.panBy(this.viewport.deltaPointsFromPixels(new window.OpenSeadragon.Point(far * x, far * y))).applyConstraints();
  }

  setMode(mode) {
    this.mode = mode;
    this.hold(false);
  }

  hold(on) {
    this.root.dataset.shown = on || !this.hasAfter ? "before" : this.mode;
    this.told();
  }

  // Lay a canvas over the corrected photo where it belongs, in photo pixels.
  cover(canvas, { x, y, width, height }) {
    const [, after] = this.panes;
    const place = after.viewport.imageToViewportRectangle(x, y, width, height);
    if (canvas.isConnected) after.updateOverlay(canvas, place);
    else after.addOverlay(canvas, place);
  }

  onChange(listener) {
    this.listeners.add(listener);
  }

  told() {
    for (const listener of this.listeners) listener(this);
  }

  moved(pane) {
    const { viewport } = this;
    for (const other of this.panes.filter((each) => each !== this.leader && each.viewport)) {
      other.viewport.zoomTo(viewport.getZoom(true), null, true);
      other.viewport.panTo(viewport.getCenter(true), true);
    }
    if (pane !== this.leader) return;
    if (this.refit) this.fit();
    const scale = viewport.viewportToImageZoom(viewport.getZoom(true)) * ratio();
    for (const pane of this.panes) pane.drawer?.setImageSmoothingEnabled(scale < 0.999);
    this.root.classList.toggle("close", scale >= 0.999);
    this.fitted = Math.abs(viewport.getZoom() / viewport.getHomeZoom() - 1) < 1e-3;
    this.root.querySelector(".zoom-words").textContent = `${Math.round(scale * 100)} %`;
    this.told();
    clearTimeout(this.noting);
    this.noting = setTimeout(() => {
      const { x, y } = this.centre;
      const at = this.fitted ? "" : `#at=${Math.round(x)},${Math.round(y)},${scale.toFixed(2)}`;
      history.replaceState(null, "", `${location.pathname}${location.search}${at}`);
    }, 300);
  }

  fromAddress() {
    const [, ...place] = /^#at=(\d+),(\d+),([\d.]+)$/.exec(location.hash) ?? [];
    if (place.length) this.goTo(...place.map(Number));
  }
}

export function setUpViewer() {
  const root = byId("viewer");
  if (!root) return null;
  const viewer = new Viewer(root);
  for (const button of root.querySelectorAll("button")) button.disabled = false;
  setUpTools(root, viewer);
  setUpHold(root, viewer);
  setUpSplit(root, viewer);
  setUpPlaces(root, viewer);
  return viewer;
}

function setUpTools(root, viewer) {
  const whole = root.querySelector('[data-act="window"]');
  const fill = (on) => {
    root.classList.toggle("whole", on);
    document.documentElement.classList.toggle("covered", on);
    whole.setAttribute("aria-pressed", String(on));
    whole.textContent = on ? "Back to the page" : "Whole window";
  };
  const acts = {
    in: () => viewer.zoom(1.5),
    out: () => viewer.zoom(1 / 1.5),
    fit: () => viewer.fit(),
    one: () => viewer.goTo(viewer.centre.x, viewer.centre.y),
    window: () => fill(!root.classList.contains("whole")),
  };
  const keys = {
    ...{ ArrowLeft: () => viewer.pan(-1, 0), ArrowRight: () => viewer.pan(1, 0), ArrowUp: () => viewer.pan(0, -1), ArrowDown: () => viewer.pan(0, 1) },
    ...{ "+": acts.in, "=": acts.in, "-": acts.out, 0: acts.fit, 1: acts.one },
  };
  for (const button of root.querySelectorAll("[data-act]")) button.addEventListener("click", () => acts[button.dataset.act]());
  viewer.stage.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || event.target.matches(".handle") || !keys[event.key]) return;
    event.preventDefault();
    keys[event.key]();
  });
  document.addEventListener("keydown", (event) => {
    if (event.key === "Escape" && root.classList.contains("whole")) fill(false);
  });
  const modes = [...root.querySelectorAll("[data-mode]")];
  const show = () => {
    for (const button of modes) button.setAttribute("aria-pressed", String(button.dataset.mode === viewer.mode));
    for (const part of root.querySelectorAll(".modes, .hold")) part.hidden = !viewer.hasAfter;
    root.querySelector(".handle").hidden = root.dataset.shown !== "split";
  };
  for (const button of modes) button.addEventListener("click", () => viewer.setMode(button.dataset.mode));
  viewer.onChange(show);
  show();
}

function setUpHold(root, viewer) {
  const button = root.querySelector(".hold");
  const hold = (on) => {
    viewer.hold(on);
    button.setAttribute("aria-pressed", String(on));
  };
  button.addEventListener("pointerdown", (event) => {
    button.setPointerCapture(event.pointerId);
    hold(true);
  });
  for (const kind of ["pointerup", "pointercancel", "blur"]) button.addEventListener(kind, () => hold(false));
  const typing = (target) => target.matches("input, select, textarea") && target.type !== "range";
  const isKey = (event) =>
    (event.key.toLowerCase() === "b" && !event.ctrlKey && !event.metaKey && !event.altKey && !typing(event.target)) ||
    (event.target === button && (event.key === " " || event.key === "Enter"));
  document.addEventListener("keydown", (event) => {
    if (!isKey(event)) return;
    event.preventDefault();
    if (!event.repeat) hold(true);
  });
  document.addEventListener("keyup", (event) => isKey(event) && hold(false));
  window.addEventListener("blur", () => hold(false));
}

function setUpSplit(root, { stage }) {
  const handle = root.querySelector(".handle");
  let split = 0.5;
  const move = (share) => {
    split = Math.min(0.98, Math.max(0.02, share));
    handle.setAttribute("aria-valuenow", String(Math.round(split * 100)));
    stage.style.setProperty("--split", `${split * 100}%`);
  };
  handle.addEventListener("pointerdown", (event) => handle.setPointerCapture(event.pointerId));
  handle.addEventListener("pointermove", (event) => {
    const { left, width } = stage.getBoundingClientRect();
    if (handle.hasPointerCapture(event.pointerId)) move((event.clientX - left) / width);
  });
  handle.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: -0.02, ArrowRight: 0.02, ArrowDown: -0.02, ArrowUp: 0.02 }[event.key];
    if (step === undefined) return;
    event.preventDefault();
    move(split + step);
  });
}

// Nine places of the picture as small crops: choosing one brings the view there, pixel by pixel.
function setUpPlaces(root, viewer) {
  const places = [...document.querySelectorAll(".mosaic button")];
  for (const place of places) {
    const { row, col } = place.dataset;
    place.disabled = false;
    place.addEventListener("click", () => {
      viewer.goTo(col * viewer.width, row * viewer.height);
      root.scrollIntoView({ block: "start" });
      for (const other of places) other.setAttribute("aria-pressed", String(other === place));
    });
  }
}
