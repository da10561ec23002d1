// What several parts share.

export const byId = (id) => document.getElementById(id);

const PLAIN = {
  not_an_image: "Not a photo file. Send RAW, DNG, TIFF, PNG or JPEG.",
  unsupported_format: "This kind of file cannot be read. Send RAW, DNG, TIFF, PNG or JPEG.",
  truncated_image: "The file ends too early. Copy it again from the camera or card.",
  image_too_large: "This photo is larger than the service takes.",
  decompression_bomb: "This file would unpack to far more than a photo holds.",
};

// An answer that something was refused, as an error: a sentence for people, and its code for those who know what to do.
export function failure(answered, status) {
  try {
    const { code, detail, errors } = JSON.parse(answered);
    const first = errors?.[0]?.message;
    const text = first && !detail.includes(first) ? `${detail}: ${first}` : detail;
    return Object.assign(new Error(PLAIN[code] ?? text[0].toUpperCase() + text.slice(1)), { code });
  } catch {
    return new Error(`The service answered ${status}. Try again in a moment.`);
  }
}

// Ask the service: its answer, or an error with what it said.
export async function ask(url, options) {
  const response = await fetch(url, options);
  if (!response.ok) throw failure(await response.text(), response.status);
  return response;
}

// Do what may meet another lens than the one that is named: where it does, ask, and do it all the same.
export async function withItsLens(act) {
  try {
    return await act(false);
  } catch (reason) {
    if (reason.code !== "other_lens") throw reason;
    const [, why] = /: (.*?)(?:; choose its own lens.*)?$/.exec(reason.message) ?? [null, reason.message];
    return (await confirmed(`This seems to be another lens: ${why}.`, "It is the same lens")) ? act(true) : null;
  }
}

export async function send(method, url, body) {
  const headers = { "Content-Type": "application/json" };
  const response = await ask(url, { method, headers, body: body === undefined ? undefined : JSON.stringify(body) });
  return response.status === 204 ? null : response.json();
}

// Let a form act. `act` gives the address to go on at, true for this page anew, or nothing; its errors are said in the
// form. Until it answers the form takes no second wish.
export function acting(form, act, alert = form?.querySelector(".alert")) {
  if (!form) return;
  for (const button of form.querySelectorAll("button")) button.disabled = false; // until now a click would have gone nowhere
  const free = () => form.removeAttribute("aria-busy");
  window.addEventListener("pageshow", free); // back from where it went on
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    if (form.matches("[aria-busy]")) return;
    if (alert) alert.hidden = true;
    form.setAttribute("aria-busy", "true");
    try {
      const onward = await act(new FormData(form), form, event.submitter);
      if (onward === true) location.reload();
      else if (onward) location.assign(onward);
      else free();
    } catch (reason) {
      alert.textContent = reason.message;
      alert.hidden = false;
      free();
    }
  });
}

// Ask before what cannot be undone: whether the answer is yes.
export function confirmed(question, yes) {
  const dialog = document.createElement("dialog");
  dialog.setAttribute("aria-labelledby", "question");
  dialog.innerHTML =
    '<form method="dialog"><p id="question"></p><p class="actions"><button value="yes"></button><button class="quiet" value="" autofocus>Cancel</button></p></form>';
  dialog.querySelector("p").textContent = question;
  dialog.querySelector("[value=yes]").textContent = yes;
  document.body.append(dialog);
  dialog.showModal();
  return new Promise((resolve) => {
    dialog.addEventListener("close", () => {
      dialog.remove();
      resolve(dialog.returnValue === "yes");
    });
  });
}
