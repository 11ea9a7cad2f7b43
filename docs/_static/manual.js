"use strict";
// What the theme leaves out for readers of the keyboard and of screen readers.
addEventListener("DOMContentLoaded", () => {
  for (const [part, name] of [[".sidebar-drawer", "Site"], [".toc-drawer", "On this page"]])
    document.querySelector(part)?.setAttribute("aria-label", name);
  for (const box of document.querySelectorAll("pre, .table-wrapper")) box.tabIndex = 0;
  // The theme gives the captions of the sidebar the role of headings, and no level.
  for (const caption of document.querySelectorAll(".caption[role=heading]")) caption.ariaLevel = "2";
  // The empty corner of a table heads nothing.
  for (const head of document.querySelectorAll("th.head")) {
    if (!head.textContent.trim()) {
      const cell = document.createElement("td");
      cell.className = head.className;
      head.replaceWith(cell);
    }
  }
  if (!document.querySelector("h1")) {
    const title = document.createElement("h1");
    title.textContent = document.title.split(" - ")[0];
    document.querySelector("article")?.prepend(title);
  }
});
