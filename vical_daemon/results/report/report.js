"use strict";
// Copies a matrix, and starts the 3-D views. Works from a file, offline.

for (const button of document.querySelectorAll("button.copy")) {
  button.onclick = async () => {
    const source = button.parentElement.querySelector("pre");
    try {
      await navigator.clipboard.writeText(source.textContent);
      button.textContent = "copied";
    } catch (error) { // not allowed here: select it, so that one key press copies it
      getSelection().selectAllChildren(source);
      button.textContent = "selected: press Ctrl-C";
    }
    setTimeout(() => { button.textContent = "copy"; }, 2500);
  };
}

for (const holder of document.querySelectorAll(".scene")) {
  const scene = new Scene(holder.querySelector("canvas"));
  scene.set(JSON.parse(holder.querySelector("script").textContent));
  sceneButtons(scene, holder);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => scene.draw());
}
