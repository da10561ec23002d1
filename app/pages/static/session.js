// Signing in and out. The key goes to the service once; afterwards a cookie that scripts cannot read stands for it.

import { acting, byId, send } from "./common.js";

// Where to go on: a page of this service, whatever the address says.
function onward() {
  const wanted = new URLSearchParams(location.search).get("next") ?? "/";
  try {
    const target = new URL(wanted, location.origin);
    return target.origin === location.origin && target.pathname !== "/sign-in" ? target.pathname + target.search : "/";
  } catch {
    return "/";
  }
}

async function known() {
  const response = await fetch("/v1/account");
  return response.ok ? response.json() : null;
}

export async function setUpSignIn() {
  const form = byId("sign-in");
  if (!form) return;
  byId("unsafe").hidden = window.isSecureContext;
  acting(form, async () => {
    await send("POST", "/v1/session", { key: byId("key").value.trim() }).catch((reason) => {
      byId("key").focus();
      throw reason;
    });
    location.replace(onward());
  }, byId("sign-in-error"));
  // a link on another site comes without the cookie, though the browser has it
  if (await known()) location.replace(onward());
}

export async function setUpSignOut() {
  const button = byId("sign-out");
  if (!button) return;
  const session = byId("sign-in") ? null : await known();
  button.hidden = !session?.signed_in;
  if (session?.signed_in) button.title = `Signed in as ${session.owner}`;
  button.addEventListener("click", async () => {
    await fetch("/v1/session", { method: "DELETE" });
    location.assign("/sign-in");
  });
}
