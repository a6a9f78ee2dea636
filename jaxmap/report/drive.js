// The drive: a slider over the key frames that moves the camera in 3D and from above, and the pictures, together.
(function () {
  const drive = document.getElementById("drive"), data = document.getElementById("drive-data");
  if (!drive || !data) return;
  const views = JSON.parse(data.textContent), rows = Array.from(drive.querySelectorAll(".frame"));
  const scrubber = drive.querySelector(".scrubber"), slider = scrubber.querySelector("input");
  const play = scrubber.querySelector("button"), text = scrubber.querySelector("output");
  const place = document.getElementById("view3d"), above = drive.querySelector(".above svg");
  let shown = -1, trace = null, timer = null;

  // Lines from the camera to the corners of what it sees, and round that.
  function lines(view) {
    const line = { x: [], y: [], z: [] };
    const add = (point) => ["x", "y", "z"].forEach((axis, i) => line[axis].push(point ? point[i] : null));
    if (!view.camera) return line;
    const side = view.outline.length / 4;
    for (let corner = 0; corner < 4; corner++) [view.camera, view.outline[corner * side], null].forEach(add);
    [...view.outline, view.outline[0]].forEach(add);
    return line;
  }

  function in3d(view) {
    if (trace === null) return;
    const line = lines(view);
    Plotly.restyle(place, { x: [line.x], y: [line.y], z: [line.z] }, [trace]);
  }

  function fromAbove(view) {
    if (!above) return;
    const there = Boolean(view.camera_px), points = there ? view.outline_px : [];
    above.querySelector(".seen").setAttribute("d", there ? "M" + points.map((p) => p.join(" ")).join("L") + "Z" : "");
    const camera = above.querySelector(".camera"), scale = above.viewBox.baseVal.width / 100;
    camera.setAttribute("r", there ? 1.6 * scale : 0);
    if (there) { camera.setAttribute("cx", view.camera_px[0][0]); camera.setAttribute("cy", view.camera_px[0][1]); }
  }

  function show(index) {
    index = Math.max(0, Math.min(views.length - 1, index));
    if (index === shown) return;
    shown = index;
    const view = views[index];
    slider.value = index;
    rows.forEach((row, i) => { row.hidden = i !== index; });
    text.textContent = ["frame " + view.name, index + 1 + " of " + views.length, view.driven].filter(Boolean).join(" · ");
    slider.setAttribute("aria-valuetext", text.textContent);
    fromAbove(view);
    in3d(view);
    document.documentElement.dataset.frame = view.name;
  }

  function stop() {
    clearInterval(timer);
    timer = null;
    play.textContent = "▶";
    play.setAttribute("aria-label", "Play");
  }
  play.addEventListener("click", () => {
    if (timer !== null) { stop(); return; }
    if (shown === views.length - 1) show(0);
    play.textContent = "❚❚";
    play.setAttribute("aria-label", "Pause");
    timer = setInterval(() => { show(shown + 1); if (shown === views.length - 1) stop(); }, 600);
  });
  slider.addEventListener("input", () => { stop(); show(Number(slider.value)); });
  document.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key], box = drive.getBoundingClientRect();
    if (!step || event.target === slider || event.ctrlKey || event.metaKey || event.altKey) return;
    if (box.bottom < 0 || box.top > innerHeight) return;
    stop();
    show(shown + step);
    event.preventDefault();
  });

  scrubber.hidden = false;
  drive.classList.add("moving");
  if (place) {
    place.addEventListener("drawn", () => {
      const line = { type: "scatter3d", mode: "lines", hoverinfo: "skip", line: { color: "#c026d3", width: 5 } };
      Plotly.addTraces(place, { ...line, ...lines(views[shown]) }).then(() => { trace = place.data.length - 1; });
    });
  }
  show(0);
})();
