// Photos chosen or dropped are sent one after the other; what became of them is in the list below.

import { byId, refusalText } from "./common.js";

function uploadOne(file, calibrate, list) {
  const item = document.createElement("li");
  item.innerHTML = '<div class="grow"><b></b><p></p><progress max="1" value="0"></progress></div>';
  const [name, words, bar] = [item.querySelector("b"), item.querySelector("p"), item.querySelector("progress")];
  name.textContent = file.name;
  words.textContent = "Waiting to be sent";
  bar.setAttribute("aria-label", `Upload of ${file.name}`);
  list.append(item);
  return () =>
    new Promise((resolve) => {
      const request = new XMLHttpRequest();
      const query = new URLSearchParams({ filename: file.name, calibrate: String(calibrate) });
      request.open("POST", `/v1/photos?${query}`);
      request.setRequestHeader("Content-Type", "application/octet-stream");
      request.upload.onprogress = (event) => {
        bar.value = event.total ? event.loaded / event.total : 0;
        words.textContent = `Sending, ${Math.round(bar.value * 100)} %`;
      };
      const fail = (text) => {
        bar.remove();
        const close = document.createElement("button");
        close.type = "button";
        close.className = "quiet";
        close.textContent = "Dismiss";
        close.setAttribute("aria-label", `Dismiss the message about ${file.name}`);
        close.addEventListener("click", () => item.remove());
        item.append(close);
        words.className = "error";
        words.textContent = text;
        resolve(false);
      };
      request.onerror = () => fail("The connection was lost. Choose the photo again; nothing is counted twice.");
      request.onload = () => {
        if (request.status === 202 || request.status === 200) {
          item.remove();
          resolve(true);
          return;
        }
        fail(refusalText(request.responseText, request.status));
      };
      request.send(file);
    });
}

export function setUpUpload() {
  const form = byId("drop");
  if (!form) return;
  const [input, list, announce] = [byId("files"), byId("uploads"), byId("announce")];
  const start = async (files) => {
    const jobs = [...files].map((file) => uploadOne(file, byId("calibrate").checked, list));
    let done = 0;
    for (const job of jobs) {
      if (await job()) done += 1;
      window.htmx?.trigger("#photos", "refresh");
    }
    const refused = jobs.length - done;
    announce.textContent = `${done} of ${jobs.length} photos sent${refused ? `, ${refused} refused` : ""}.`;
  };
  input.addEventListener("change", async () => {
    const files = [...input.files];
    input.value = "";
    await start(files);
  });
  form.addEventListener("submit", (event) => event.preventDefault());
  // the whole page takes photos: a drop beside the frame would otherwise leave the page
  const carriesFiles = (event) => event.dataTransfer?.types.includes("Files");
  for (const kind of ["dragenter", "dragover"]) {
    document.addEventListener(kind, (event) => {
      if (!carriesFiles(event)) return;
      event.preventDefault();
      document.body.classList.add("over");
    });
  }
  document.addEventListener("dragleave", (event) => {
    if (!event.relatedTarget) document.body.classList.remove("over");
  });
  document.addEventListener("drop", (event) => {
    if (!carriesFiles(event)) return;
    event.preventDefault();
    document.body.classList.remove("over");
    start(event.dataTransfer.files);
  });
}
