// Wide tables scroll sideways: the keyboard must reach them too. Landmarks of one kind need names of their own.
function tidy() {
  for (const wrap of document.querySelectorAll(".md-typeset__scrollwrap")) wrap.tabIndex = 0;
  document.querySelectorAll(".md-code__nav").forEach((nav, index) => nav.setAttribute("aria-label", `Code ${index + 1}`));
}
new MutationObserver(tidy).observe(document.body, { childList: true, subtree: true });
tidy();
