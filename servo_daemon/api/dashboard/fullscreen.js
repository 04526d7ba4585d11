// A button that shows a card, or anything else, on the whole screen, and goes back.

/** @param {string} what it shows, in words */
export function fullScreen(button, element, what) {
  button.setAttribute("aria-label", `${what} in full screen`);
  button.title = "Full screen";
  button.hidden = !document.fullscreenEnabled;
  button.addEventListener("click", () => {
    if (document.fullscreenElement) document.exitFullscreen();
    else element.requestFullscreen();
  });
}
