// What scrolls can be scrolled by keys.
const reach = () => document.querySelectorAll(".md-typeset__scrollwrap:not([tabindex])").forEach((box) => {
  box.tabIndex = 0;
  box.setAttribute("role", "group");
  box.setAttribute("aria-label", "Table");
});
new MutationObserver(reach).observe(document.body, {childList: true, subtree: true});
reach();
