// Before and after at 1:1: slider, hold key and button, nine places of the picture.

import { byId } from "./common.js";

const SHAPE = 420 / 640;
const WIDEST = 1200;

// A corner full of sky shows nothing: begin where there is most to see.
async function mostDetailed(tiles) {
  await Promise.allSettled(tiles.map((tile) => tile.decode()));
  const detail = tiles.map((tile) => {
    const canvas = new OffscreenCanvas(85, 56);
    const context = canvas.getContext("2d");
    context.drawImage(tile, 0, 0, 85, 56);
    const { data } = context.getImageData(0, 0, 85, 56);
    let sum = 0;
    for (let i = 4; i < data.length; i += 4) sum += Math.abs(data[i + 1] - data[i - 3]);
    return sum;
  });
  return detail.indexOf(Math.max(...detail));
}

export function setUpCompare() {
  const holder = byId("compare");
  if (!holder) return;
  const slider = holder.querySelector("img-comparison-slider");
  const [before, after] = slider.querySelectorAll("img");
  const [hold, button] = [byId("hold"), byId("hold-button")];
  const tag = holder.querySelector(".tag.after");
  const places = [...document.querySelectorAll(".mosaic button")];
  const tiles = places.map((place) => place.querySelector("img"));

  // the crop is as wide as its frame, so that a pixel of the photo is a pixel of the page
  const show = (place) => {
    for (const other of places) other.setAttribute("aria-pressed", String(other === place));
    holder.style.maxWidth = "";
    const width = Math.min(WIDEST, Math.floor(holder.clientWidth));
    const height = Math.min(560, Math.max(240, Math.round(width * SHAPE)));
    const { row, col } = place.dataset;
    const query = new URLSearchParams({ row, col, width: String(width), height: String(height) });
    for (const picture of [before, after, hold]) Object.assign(picture, { width, height });
    before.src = `/ui/photos/${holder.dataset.photo}/crop.png?correction=${holder.dataset.id}&${query}`;
    hold.src = before.src;
    after.src = `/ui/corrections/${holder.dataset.id}/crop.png?${query}`;
    slider.setAttribute("aria-valuetext", `${place.textContent.trim()}: half before, half after`);
  };
  // a photo smaller than the frame is not blown up
  before.addEventListener("load", () => {
    holder.style.maxWidth = `${before.naturalWidth}px`;
  });
  const holdBefore = (on) => {
    hold.hidden = !on;
    tag.hidden = on;
    button.setAttribute("aria-pressed", String(on));
    for (const tile of tiles) tile.src = on ? tile.dataset.before : tile.dataset.after;
  };
  slider.addEventListener("slide", () => {
    slider.setAttribute("aria-valuenow", String(Math.round(slider.value)));
    slider.setAttribute("aria-valuetext", `${Math.round(slider.value)} % before`);
  });
  for (const place of places) place.addEventListener("click", () => show(place));
  button.addEventListener("pointerdown", (event) => {
    button.setPointerCapture(event.pointerId);
    holdBefore(true);
  });
  for (const kind of ["pointerup", "pointercancel", "blur"]) button.addEventListener(kind, () => holdBefore(false));
  const isHoldKey = (event) =>
    (event.key.toLowerCase() === "b" && !event.ctrlKey && !event.metaKey && !event.altKey) ||
    (event.target === button && (event.key === " " || event.key === "Enter"));
  document.addEventListener("keydown", (event) => {
    if (!isHoldKey(event)) return;
    event.preventDefault();
    if (!event.repeat) holdBefore(true);
  });
  document.addEventListener("keyup", (event) => {
    if (isHoldKey(event)) holdBefore(false);
  });
  for (const tile of tiles) new Image().src = tile.dataset.before;
  holdBefore(false);
  mostDetailed(tiles).then((index) => show(places[index]));
}
