// An open page asks every two seconds for its parts, and takes over what has changed.

import { byId } from "./common.js";

const PAUSE_MS = 2000;

let afterwards = "/"; // where to go when what the page shows is gone
let leaving = false; // the answer and the next look both tell of it: the second going would break off the first

function leave() {
  if (leaving) return;
  leaving = true;
  location.assign(afterwards);
}

// Do what removes what the page shows, and go on at `url`: the next look may tell of it before the answer comes.
export async function removing(url, act) {
  afterwards = url;
  try {
    await act();
  } catch (reason) {
    afterwards = "/";
    throw reason;
  }
  leave();
}

// Make `old` like `fresh` and keep what is alike: focus, open details, what was typed.
export function merge(old, fresh) {
  const kept = [...old.childNodes];
  const known = new Map(kept.filter((node) => node.id).map((node) => [node.id, node]));
  let at = 0;
  for (const node of [...fresh.childNodes]) {
    const place = old.childNodes[at] ?? null;
    const same = node.id ? known.get(node.id) : place && !place.id && place.nodeName === node.nodeName ? place : null;
    if (!same) old.insertBefore(node, place);
    else {
      if (same !== place) old.insertBefore(same, place);
      mergeNode(same, node);
    }
    at += 1;
  }
  while (old.childNodes.length > at) old.lastChild.remove();
}

function mergeNode(old, fresh) {
  if (old.isEqualNode(fresh)) return;
  if (old.nodeType !== Node.ELEMENT_NODE) {
    old.nodeValue = fresh.nodeValue;
    return;
  }
  if (old.nodeName !== fresh.nodeName) {
    old.replaceWith(fresh);
    return;
  }
  if (fresh.matches(".alert[hidden]")) return; // what the page itself said stays
  const typed = old.matches("input, select, textarea");
  for (const { name, value } of fresh.attributes) if (old.getAttribute(name) !== value) old.setAttribute(name, value);
  for (const { name } of [...old.attributes])
    if (!fresh.hasAttribute(name) && name !== "open" && !(typed && name === "disabled")) old.removeAttribute(name);
  if (typed && old.nodeName !== "SELECT") return;
  merge(old, fresh);
}

// Bring the page up to date at once.
export let refreshed = async () => {};

export function setUpPolling(onPart) {
  const { page, id } = document.body.dataset;
  if (!page) return;
  const away = byId("away");
  const url = `/ui/parts?${new URLSearchParams({ page, id: id ?? "" })}`;
  let [timer, tag] = [0, ""];
  const take = (parts) => {
    for (const [name, html] of Object.entries(parts)) {
      const target = byId(name);
      if (!target) continue;
      const fresh = document.createElement("template");
      fresh.innerHTML = html;
      merge(target, fresh.content);
      onPart(name);
    }
  };
  const look = async () => {
    clearTimeout(timer);
    if (document.hidden) return; // shown again it is brought up to date
    try {
      const response = await fetch(url, { headers: tag ? { "If-None-Match": tag } : {}, cache: "no-store" });
      away.hidden = response.status < 500;
      if (response.status === 401) {
        location.assign(`/sign-in?next=${encodeURIComponent(location.pathname)}`);
        return;
      }
      if (response.status === 404) {
        leave();
        return;
      }
      if (response.ok) {
        tag = response.headers.get("ETag") ?? "";
        take(await response.json());
      }
    } catch {
      away.hidden = false;
    }
    clearTimeout(timer);
    timer = setTimeout(look, PAUSE_MS);
  };
  refreshed = look;
  // a service on this very computer needs no network: ask it whether it is there
  for (const event of ["offline", "online"]) window.addEventListener(event, look);
  document.addEventListener("visibilitychange", look);
  window.addEventListener("pageshow", (event) => (leaving &&= !event.persisted)); // come back to
  timer = setTimeout(look, PAUSE_MS);
}
