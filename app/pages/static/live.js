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
  const wait = (event) => {
    if (document.hidden || occupied() || (typing() && !live.contains(document.activeElement))) event.preventDefault();
  };
  on("before:request", wait);
  on("before:response", wait); // it was asked for before
  on("after:request", ({ detail }) => (away.hidden = detail.ctx.response.status < 500));
  on("error", () => (away.hidden = false));
  on("before:swap", () => (within = live.contains(document.activeElement)));
  on("after:swap", () => {
    if (within && document.activeElement === document.body) (document.querySelector("[data-leave]") ?? byId("next-title") ?? byId("photos-title") ?? byId("main")).focus();
  });
  // a service on this very computer needs no network: ask it whether it is there
  for (const event of ["offline", "online"]) window.addEventListener(event, refresh);
  document.addEventListener("visibilitychange", refresh);
}

// A page that is loaded again has open what was open, and the focus where it was, also on what has taken its place.
export function keepPlace() {
  window.addEventListener("pagehide", () => {
    const open = [...document.querySelectorAll("details[open] > summary")].map(({ textContent }) => textContent);
    sessionStorage.setItem("place", JSON.stringify({ open, focus: document.activeElement?.id }));
  });
  if (performance.getEntriesByType("navigation")[0]?.type !== "reload") return;
  const { open = [], focus } = JSON.parse(sessionStorage.getItem("place") ?? "{}");
  for (const summary of document.querySelectorAll("details > summary")) summary.parentElement.open ||= open.includes(summary.textContent);
  if (focus) (byId(focus) ?? byId("main")).focus({ preventScroll: true });
}
