// Open pages: htmx asks every two seconds for the part that changes, and merges it in.

import { byId } from "./common.js";

// Bring the page up to date at once.
export const refresh = () => window.htmx.trigger("#live", "every");

// Whether somebody is asked or waits for what a form does: then nothing may change or take the page away.
const occupied = () => document.querySelector("dialog[open], form[aria-busy=true], #photo-actions[aria-busy=true]");
const typing = () => document.activeElement?.matches("input:not([type=checkbox]), select");

export function setUpLive() {
  const live = byId("live");
  if (!live) return;
  const away = byId("away");
  let within = false;
  const on = (name, act) => document.addEventListener(`htmx:${name}`, act);
  on("before:request", (event) => {
    if (document.hidden || occupied() || (typing() && !live.contains(document.activeElement))) event.preventDefault();
  });
  on("after:request", ({ detail }) => (away.hidden = detail.ctx.response.status < 500));
  on("error", () => (away.hidden = false));
  on("before:swap", () => (within = live.contains(document.activeElement)));
  on("after:swap", () => {
    if (within && document.activeElement === document.body) (document.querySelector("[data-leave]") ?? byId("photos-title") ?? byId("main")).focus();
  });
  // a service on this very computer needs no network: ask it whether it is there
  for (const event of ["offline", "online"]) window.addEventListener(event, refresh);
  document.addEventListener("visibilitychange", refresh);
}

// A page that is loaded again has the focus where it was, also on what has taken the place of a button.
export function keepFocus() {
  window.addEventListener("pagehide", () => sessionStorage.setItem("focus", document.activeElement?.id ?? ""));
  if (performance.getEntriesByType("navigation")[0]?.type !== "reload") return;
  const name = sessionStorage.getItem("focus");
  if (!name) return;
  const at = byId(name) ?? byId("main");
  for (let part = at.closest("details"); part; part = part.parentElement.closest("details")) part.open = true;
  at.focus({ preventScroll: true });
}
