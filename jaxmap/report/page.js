"use strict";
// The state of the page, as attributes of <html>: what loaded, and whether the 3D view is drawn.
(function () {
  const root = document.documentElement;

  function countImages() {
    const images = Array.from(document.images);
    root.dataset.images = images.filter((image) => image.complete && image.naturalWidth > 0).length + "/" + images.length;
  }
  window.addEventListener("load", countImages);

  const place = document.getElementById("view3d");
  if (!place) return;
  let figure = null;

  // The figure is JSON, compressed, in base64: in the page it takes a fifth of its size.
  async function read() {
    const packed = atob(document.getElementById("view3d-data").textContent);
    const bytes = Uint8Array.from(packed, (letter) => letter.charCodeAt(0));
    return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"))).json();
  }

  function theme() {
    const style = getComputedStyle(root);
    const colour = (name) => style.getPropertyValue(name).trim();
    const look = {
      "font.color": colour("--ink"), "font.family": getComputedStyle(document.body).fontFamily,
      "modebar.bgcolor": "rgba(0,0,0,0)", "modebar.color": colour("--quiet"), "modebar.activecolor": colour("--ink"),
    };
    if ((figure.layout.updatemenus || []).length) {
      look["updatemenus[0].bgcolor"] = colour("--button");
      look["updatemenus[0].bordercolor"] = colour("--line");
      look["updatemenus[0].font.color"] = colour("--ink");
    }
    return look;
  }

  function fail(reason) {
    root.dataset.view3d = "failed";
    place.innerHTML = "<p>The 3D view cannot be drawn here: it needs WebGL.</p>";
    console.warn(reason);
  }

  async function draw() {
    figure = await read();
    // The first view is made for a wide place: in a narrow one it steps back.
    const back = Math.max(1, (1.4 * place.clientHeight) / place.clientWidth);
    for (const axis of ["x", "y", "z"]) figure.layout.scene.camera.eye[axis] *= back;
    const options = {
      displaylogo: false, responsive: true, scrollZoom: true,
      modeBarButtonsToRemove: ["resetCameraLastSave3d", "orbitRotation", "pan3d", "zoom3d"],
    };
    await Plotly.newPlot(place, figure.data, figure.layout, options);
    await Plotly.relayout(place, theme());
    root.dataset.view3d = "drawn";
    place.dispatchEvent(new Event("drawn"));
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => Plotly.relayout(place, theme()));
  }
  draw().catch(fail);
})();
