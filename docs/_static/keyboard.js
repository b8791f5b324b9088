// What scrolls can be reached and scrolled with the keyboard, and captions in the menu say their level.
addEventListener("load", () => {
  for (const box of document.querySelectorAll("article :is(.table-wrapper, pre)")) {
    if (box.scrollWidth > box.clientWidth) box.tabIndex = 0;
  }
  for (const caption of document.querySelectorAll("p.caption[role=heading]")) caption.ariaLevel = "2";
});
