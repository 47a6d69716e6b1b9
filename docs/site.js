// What scrolls can be scrolled by keys, and the buttons of each block of code have a name.
const reach = () => {
  document.querySelectorAll(".md-typeset__scrollwrap:not([tabindex])").forEach((box) => {
    box.tabIndex = 0;
    box.setAttribute("role", "group");
    box.setAttribute("aria-label", "Table");
  });
  document.querySelectorAll(".md-code__nav:not([aria-label])").forEach((buttons) => {
    buttons.setAttribute("aria-label", buttons.parentElement.id.replace(/\D+/, "Code "));
  });
};
new MutationObserver(reach).observe(document.body, {childList: true, subtree: true});
reach();
