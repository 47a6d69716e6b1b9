// Marks tables and figures that are wider than the window, so that they say that they scroll.
(() => {
  "use strict";
  document.documentElement.classList.add("scripted");
  const boxes = [...document.querySelectorAll(".scroll")];
  const look = () => boxes.forEach((box) => {
    const wider = box.classList.toggle("overflows", box.scrollWidth > box.clientWidth + 1);
    if (wider) box.tabIndex = 0; // the keys scroll it; what fits is no stop of the tab key
    else box.removeAttribute("tabindex");
  });
  look();
  addEventListener("resize", look);
  document.querySelectorAll("details").forEach((fold) => fold.addEventListener("toggle", look));
})();
