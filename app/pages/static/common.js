// What several parts share.

export const byId = (id) => document.getElementById(id);

const PLAIN = {
  not_an_image: "Not a photo file. Send RAW, DNG, TIFF, PNG or JPEG.",
  unsupported_format: "This kind of file cannot be read. Send RAW, DNG, TIFF, PNG or JPEG.",
  truncated_image: "The file ends too early. Copy it again from the camera or card.",
  image_too_large: "This photo is larger than the service takes.",
  decompression_bomb: "This file would unpack to far more than a photo holds.",
};

export async function problemText(response) {
  try {
    const problem = await response.json();
    if (PLAIN[problem.code]) return PLAIN[problem.code];
    const first = problem.errors?.[0]?.message;
    return first && !problem.detail.includes(first) ? `${problem.detail}: ${first}` : problem.detail;
  } catch {
    return `The service answered ${response.status}. Try again in a moment.`;
  }
}

// The answer to a refused upload as a sentence for people; the service's own words where we have none.
export function refusalText(answered, status) {
  try {
    const { code, detail } = JSON.parse(answered);
    return PLAIN[code] ?? detail[0].toUpperCase() + detail.slice(1);
  } catch {
    return `The service answered ${status}. Try again in a moment.`;
  }
}

// The answer that something was refused, as an error: its text, and its code for those who know what to do.
export async function failure(response) {
  const problem = await response.clone().json().catch(() => ({}));
  return Object.assign(new Error(await problemText(response)), { code: problem.code });
}

// Do what may meet another lens than the one that is named: where it does, ask, and do it all the same.
export async function withItsLens(act) {
  try {
    return await act(false);
  } catch (reason) {
    if (reason.code !== "other_lens") throw reason;
    const [why] = reason.message.split("; choose its own lens");
    return (await confirmed(`${why[0].toUpperCase()}${why.slice(1)}.`, "It is the same lens")) ? act(true) : null;
  }
}

export async function send(method, url, body) {
  const response = await fetch(url, {
    method,
    headers: { "Content-Type": "application/json" },
    body: body === undefined ? undefined : JSON.stringify(body),
  });
  if (!response.ok) throw await failure(response);
  return response.status === 204 ? null : response.json();
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
