// The tools around the view of a photo: ways to show it, zoom, places to jump to, the whole window.

import { byId } from "./common.js";
import { Viewer } from "./viewer.js";

export function setUpViewer() {
  const root = byId("viewer");
  if (!root) return null;
  const viewer = new Viewer(root);
  for (const button of root.querySelectorAll("button")) button.disabled = false;
  setUpModes(root, viewer);
  setUpHold(root, viewer);
  const acts = {
    in: () => viewer.zoom(1.5),
    out: () => viewer.zoom(1 / 1.5),
    fit: () => viewer.fit(),
    one: () => viewer.goTo(viewer.view.x, viewer.view.y),
    window: () => setWhole(root, !root.classList.contains("whole")),
  };
  for (const button of root.querySelectorAll("[data-act]")) button.addEventListener("click", () => acts[button.dataset.act]());
  document.addEventListener("keydown", (event) => {
    if (event.key === "Escape" && root.classList.contains("whole")) setWhole(root, false);
  });
  setUpPlaces(viewer);
  setUpOverlays(root, viewer);
  return viewer;
}

function setWhole(root, on) {
  root.classList.toggle("whole", on);
  document.documentElement.classList.toggle("covered", on);
  const button = root.querySelector('[data-act="window"]');
  button.setAttribute("aria-pressed", String(on));
  button.textContent = on ? "Back to the page" : "Whole window";
}

function setUpModes(root, viewer) {
  const buttons = [...root.querySelectorAll("[data-mode]")];
  const show = () => {
    for (const button of buttons) button.setAttribute("aria-pressed", String(button.dataset.mode === viewer.mode));
    for (const part of root.querySelectorAll(".modes, .hold")) part.hidden = !viewer.hasAfter;
  };
  for (const button of buttons)
    button.addEventListener("click", () => {
      viewer.setMode(button.dataset.mode);
      show();
    });
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
  document.addEventListener("keyup", (event) => {
    if (isKey(event)) hold(false);
  });
  window.addEventListener("blur", () => hold(false));
}

// Nine places of the picture as small crops: choosing one brings the view there, pixel by pixel.
function setUpPlaces(viewer) {
  const places = [...document.querySelectorAll(".mosaic button")];
  for (const place of places) {
    place.disabled = false;
    place.addEventListener("click", () => {
      const [row, col] = [Number(place.dataset.row), Number(place.dataset.col)];
      viewer.goTo(col * viewer.width, row * viewer.height);
      viewer.root.scrollIntoView({ block: "nearest" });
      for (const other of places) other.setAttribute("aria-pressed", String(other === place));
    });
  }
}

// Where checks held the correction back: squares over the photo, and a list that leads to the worst of them.
function setUpOverlays(root, viewer) {
  for (const place of document.querySelectorAll("[data-x]")) {
    place.disabled = false;
    place.addEventListener("click", () => {
      viewer.goTo(Number(place.dataset.x), Number(place.dataset.y));
      root.scrollIntoView({ block: "nearest" });
    });
  }
  const box = byId("show-held");
  if (!box) return;
  const { tiles, side, most } = JSON.parse(byId("held").textContent);
  box.disabled = false;
  box.addEventListener("change", () => {
    viewer.overlay = !box.checked
      ? null
      : (context, scale) => {
          for (const tile of tiles) {
            context.fillStyle = `rgb(255 60 40 / ${0.12 + (0.5 * tile.held) / most})`;
            context.fillRect(tile.x, tile.y, side, side);
          }
          context.lineWidth = 1.5 / scale;
        };
    viewer.redraw();
  });
}
