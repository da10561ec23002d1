// The search of the documents, which also works from a folder: there a browser refuses workers and requests for
// files, but not scripts. Takes the place of MkDocs' own search/main.js; `index.js` is written beside it.
"use strict";
const searchFolder = new URL(".", document.currentScript.src);
let searchIndex;

function script(name) {
  return new Promise((loaded, failed) => {
    const element = document.createElement("script");
    Object.assign(element, { src: new URL(name, searchFolder), onload: loaded, onerror: failed });
    document.head.append(element);
  });
}

async function indexed() {
  await script("lunr.js");
  await script("index.js"); // defines `searchedSections`
  return lunr(function () {
    this.ref("location");
    this.field("title", { boost: 10 });
    this.field("text");
    for (const section of searchedSections) this.add(section);
  });
}

async function search(query, results) {
  searchIndex ??= indexed();
  const found = query.length > 2 ? (await searchIndex).search(query) : [];
  const sections = new Map(found.length ? searchedSections.map((section) => [section.location, section]) : []);
  results.replaceChildren(...found.slice(0, 30).map(({ ref }) => {
    const { title, text } = sections.get(ref);
    const article = document.createElement("article");
    const link = Object.assign(document.createElement("a"), { href: new URL(`../${ref}`, searchFolder), textContent: title });
    const heading = document.createElement("h3");
    heading.append(link);
    article.append(heading, Object.assign(document.createElement("p"), { textContent: text.slice(0, 200) }));
    return article;
  }));
  if (!found.length) results.textContent = results.dataset.noResultsText || "No results found";
}

document.addEventListener("DOMContentLoaded", () => {
  const field = document.getElementById("mkdocs-search-query");
  const results = document.getElementById("mkdocs-search-results");
  field?.addEventListener("input", () => search(field.value, results));
  field?.form?.addEventListener("submit", (event) => event.preventDefault());
});
