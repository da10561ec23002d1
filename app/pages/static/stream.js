// One stream keeps the page current: the server sends a part of it whenever that part changes.

import { byId } from "./common.js";

const PATIENCE_MS = 4000;

let afterwards = "/"; // where to go when what the page shows is gone
let leaving = false; // the answer and the stream both tell of it: the second going would break off the first

function leave() {
  if (leaving) return;
  leaving = true;
  location.assign(afterwards);
}

// Do what removes what the page shows, and go on at `url`: the stream may tell of it before the answer comes.
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

export function setUpStream(onPart) {
  const { page, id } = document.body.dataset;
  if (!page) return;
  const away = byId("away");
  let [source, timer] = [null, 0];
  const open = () => {
    source = new EventSource(`/ui/events?${new URLSearchParams({ page, id: id ?? "" })}`);
    source.addEventListener("open", () => {
      clearTimeout(timer);
      timer = 0;
      away.hidden = true;
    });
    source.addEventListener("error", () => {
      timer ||= setTimeout(() => (away.hidden = false), navigator.onLine ? PATIENCE_MS : 0);
      if (source.readyState === EventSource.CLOSED) setTimeout(reopen, PATIENCE_MS);
    });
    source.addEventListener("part", (event) => {
      const target = byId(event.lastEventId);
      if (!target) return;
      const fresh = document.createElement("template");
      fresh.innerHTML = event.data;
      merge(target, fresh.content);
      onPart(event.lastEventId);
    });
    source.addEventListener("gone", () => {
      source.close();
      leave();
    });
  };
  // a page in the background holds no connection; shown again it is brought up to date
  const reopen = () => {
    source?.close();
    if (!document.hidden) open();
  };
  // a service on this very computer needs no network, and a connection of before says nothing: ask anew
  for (const event of ["offline", "online"]) window.addEventListener(event, reopen);
  document.addEventListener("visibilitychange", reopen);
  window.addEventListener("pagehide", () => source?.close());
  window.addEventListener("pageshow", (event) => (leaving &&= !event.persisted)); // come back to
  open();
}
