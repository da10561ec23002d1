// Photos chosen or dropped are sent two at a time; those that were not accepted are listed with the reason.

import { byId, failure } from "./common.js";

const AT_ONCE = 2;
// What files are that people take for photos that can be read, by their endings
const OTHERS = [
  [/\.hei[cf]$/i, "HEIC cannot be read. Send the RAW file (DNG), or the photo exported as JPEG."],
  [/\.lensprofile$/i, "This is a lens profile. Use Add a lens from a profile, under Lenses."],
];

function send(file, calibrate, onProgress) {
  return new Promise((resolve) => {
    const request = new XMLHttpRequest();
    const query = new URLSearchParams({ filename: file.name, calibrate: String(calibrate) });
    request.open("POST", `/v1/photos?${query}`);
    request.setRequestHeader("Content-Type", "application/octet-stream");
    request.upload.onprogress = (event) => onProgress(event.total ? event.loaded / event.total : 0);
    request.onerror = () => resolve({ text: "The connection was lost. Choose the photo again; nothing is counted twice." });
    request.onload = () => {
      if (request.status === 202) resolve(null);
      else if (request.status === 200) resolve({ text: "Already used: the same photo was sent before.", known: JSON.parse(request.responseText).id });
      else resolve({ text: (OTHERS.find(([ending]) => ending.test(file.name)) ?? [null, failure(request.responseText, request.status).message])[1] });
    };
    request.send(file);
  });
}

function refused(file, { text, known }) {
  const item = document.createElement("li");
  item.innerHTML = '<div class="grow"><b></b><p></p></div><button type="button" class="quiet">Dismiss</button>';
  item.querySelector("b").textContent = file.name;
  const words = item.querySelector("p");
  words.textContent = text;
  if (known) words.append(" ", Object.assign(document.createElement("a"), { href: `/photos/${known}`, textContent: "Open it" }));
  else words.className = "error";
  const close = item.querySelector("button");
  close.setAttribute("aria-label", `Dismiss the message about ${file.name}`);
  close.addEventListener("click", () => item.remove());
  byId("uploads").append(item);
}

export function setUpUpload() {
  const form = byId("drop");
  // a file that is dropped beside the fields for files must not take the place of the page
  const carriesFiles = (event) => event.dataTransfer?.types.includes("Files") && !event.target.matches?.("[type=file]");
  for (const kind of ["dragenter", "dragover", "drop"]) document.addEventListener(kind, (event) => carriesFiles(event) && event.preventDefault());
  if (!form) return;
  const [input, announce, sending] = [byId("files"), byId("announce"), byId("sending")];
  const [words, bar] = [byId("sending-words"), byId("sending-bar")];
  let [all, done, turnedAway] = [0, 0, 0];
  const parts = new Map(); // how far those are that are being sent
  const queue = [];
  const show = () => {
    const sent = done + [...parts.values()].reduce((sum, part) => sum + part, 0);
    bar.value = all ? sent / all : 0;
    words.textContent = `${done} of ${all} photos sent`;
    sending.hidden = done === all;
  };
  const work = async () => {
    for (let next = queue.shift(); next; next = queue.shift()) {
      const { file, calibrate } = next;
      parts.set(file, 0);
      const problem = await send(file, calibrate, (part) => {
        parts.set(file, part);
        show();
      });
      parts.delete(file);
      done += 1;
      if (problem) {
        turnedAway += 1;
        refused(file, problem);
      }
      show();
    }
  };
  const start = async (files) => {
    const idle = done === all;
    if (idle) [all, done, turnedAway] = [0, 0, 0];
    all += files.length;
    for (const file of files) queue.push({ file, calibrate: byId("calibrate").checked });
    show();
    if (!idle) return; // those that are sending go on with these
    await Promise.all(Array.from({ length: AT_ONCE }, work));
    announce.textContent = `${done - turnedAway} of ${all} photos sent${turnedAway ? `, ${turnedAway} not accepted` : ""}.`;
  };
  input.addEventListener("change", () => {
    const files = [...input.files];
    input.value = "";
    start(files);
  });
  form.addEventListener("submit", (event) => event.preventDefault());
  for (const kind of ["dragenter", "dragover"]) document.addEventListener(kind, (event) => carriesFiles(event) && document.body.classList.add("over"));
  document.addEventListener("dragleave", (event) => {
    if (!event.relatedTarget) document.body.classList.remove("over");
  });
  document.addEventListener("drop", (event) => {
    document.body.classList.remove("over");
    if (carriesFiles(event)) start([...event.dataTransfer.files]);
  });
}
