// The photo with its places: what became of each, and where edges tell.

import { byId } from "./common.js";

function setUpRmap() {
  const [box, picture] = [byId("show-rmap"), byId("rmap")];
  box?.addEventListener("change", () => {
    if (box.checked && !picture.src) picture.src = picture.dataset.src;
    picture.hidden = !box.checked;
    picture.parentElement.classList.toggle("mapped", box.checked);
  });
}

export function setUpPhoto() {
  setUpRmap();
  const placeWords = byId("place-words");
  const frames = [...document.querySelectorAll(".overlay rect")];
  if (!placeWords) return;
  const choose = (frame) => {
    for (const other of frames) other.classList.toggle("chosen", other === frame);
    placeWords.textContent = frame.dataset.words;
  };
  for (const frame of frames) {
    frame.addEventListener("click", () => choose(frame));
    frame.addEventListener("pointerenter", () => choose(frame));
  }
  const buttons = [...document.querySelectorAll(".reasons button")];
  for (const button of buttons) {
    button.addEventListener("click", () => {
      const on = button.getAttribute("aria-pressed") !== "true";
      for (const other of buttons) other.setAttribute("aria-pressed", String(on && other === button));
      for (const frame of frames) {
        const left = frame.classList.contains("rejected") || frame.classList.contains("failed");
        frame.classList.toggle("lit", on && left && frame.dataset.reason === button.dataset.reason);
      }
    });
  }
}
