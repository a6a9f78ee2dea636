// The detail of a large map: the voxels of a part, unpacked and drawn when it is chosen from the map from above.
(function () {
  const detail = document.getElementById("detail"), text = document.getElementById("detail-data");
  if (!detail || !text) return;
  const map = JSON.parse(text.textContent), place = document.getElementById("detail3d");
  const caption = detail.querySelector(".above figcaption"), waiting = {};
  let chosen = null;
  window.jaxmapPart = (name, packed) => waiting[name] && waiting[name](packed);

  // From the page itself or, of a large map, from a script in the folder beside it.
  function packedOf(name) {
    const inside = document.getElementById("part-" + name);
    if (inside) return Promise.resolve(inside.textContent);
    return new Promise((resolve, reject) => {
      waiting[name] = resolve;
      const script = document.createElement("script");
      script.src = map.folder + "/part-" + name + ".js";
      script.onerror = () => reject(new Error("the file " + script.getAttribute("src") + " is missing"));
      document.head.append(script);
    });
  }

  async function voxelsOf(name) {
    const bytes = Uint8Array.from(atob(await packedOf(name)), (letter) => letter.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
    const raw = new Uint8Array(await new Response(stream).arrayBuffer()), count = raw.length / 5;
    const z = new Uint16Array(count);
    for (let i = 0; i < count; i++) z[i] = raw[2 * count + 2 * i] + 256 * raw[2 * count + 2 * i + 1];
    return { count, x: raw.subarray(0, count), y: raw.subarray(count, 2 * count), z, label: raw.subarray(4 * count) };
  }

  // The faces that no other voxel hides, undersides left out: two triangles each.
  function meshOf(voxels, name) {
    const [px, py] = name.split("-").map(Number), edge = map.edge + 2, solid = new Set();
    const key = (x, y, z) => ((z + 1) * edge + y + 1) * edge + x + 1;
    for (let i = 0; i < voxels.count; i++) solid.add(key(voxels.x[i], voxels.y[i], voxels.z[i]));
    const sides = [
      [0, 0, 1, [[0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]]], [1, 0, 0, [[1, 0, 0], [1, 1, 0], [1, 1, 1], [1, 0, 1]]],
      [-1, 0, 0, [[0, 0, 0], [0, 0, 1], [0, 1, 1], [0, 1, 0]]], [0, 1, 0, [[0, 1, 0], [0, 1, 1], [1, 1, 1], [1, 1, 0]]],
      [0, -1, 0, [[0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1]]],
    ];
    const mesh = { x: [], y: [], z: [], i: [], j: [], k: [], intensity: [] };
    for (let v = 0; v < voxels.count; v++) {
      const at = [voxels.x[v], voxels.y[v], voxels.z[v]];
      const colour = voxels.label[v] === 255 ? map.names.length - 1 : voxels.label[v];
      for (const [dx, dy, dz, corners] of sides) {
        if (solid.has(key(at[0] + dx, at[1] + dy, at[2] + dz))) continue;
        const first = mesh.x.length;
        for (const corner of corners) {
          const world = [px * map.edge, py * map.edge, 0].map((o, a) => map.corner_m[a] + (o + at[a] + corner[a]) * map.size_m[a]);
          mesh.x.push(world[0]); mesh.y.push(world[1]); mesh.z.push(world[2]);
        }
        mesh.i.push(first, first); mesh.j.push(first + 1, first + 2); mesh.k.push(first + 2, first + 3);
        mesh.intensity.push(colour, colour);
      }
    }
    return mesh;
  }

  async function show(box) {
    const name = box.dataset.part;
    chosen = name;
    detail.querySelectorAll(".part.chosen").forEach((other) => other.classList.remove("chosen"));
    box.classList.add("chosen");
    caption.textContent = "Loading …";
    const voxels = await voxelsOf(name);
    if (chosen !== name) return;
    const last = map.names.length - 1, steps = map.colours.length;
    const colorscale = map.colours.flatMap((colour, i) => [[i / steps, colour], [(i + 1) / steps, colour]]);
    const trace = {
      type: "mesh3d", ...meshOf(voxels, name), intensitymode: "cell", flatshading: true, hoverinfo: "x+y+z", colorscale,
      cmin: -0.5, cmax: last + 0.5, lightposition: { x: -6e4, y: -2e4, z: 1e5 },
      lighting: { ambient: 0.65, diffuse: 0.5, specular: 0.03, roughness: 0.9, fresnel: 0, facenormalsepsilon: 0, vertexnormalsepsilon: 0 },
      colorbar: { thickness: 10, len: 0.5, tickvals: map.names.map((_, i) => i), ticktext: map.names },
    };
    const look = getComputedStyle(document.documentElement), axis = { visible: false };
    const layout = {
      margin: { l: 0, r: 0, t: 0, b: 0 }, paper_bgcolor: "rgba(0,0,0,0)",
      font: { color: look.getPropertyValue("--ink").trim(), family: getComputedStyle(document.body).fontFamily },
      modebar: { bgcolor: "rgba(0,0,0,0)", color: look.getPropertyValue("--quiet").trim() },
      scene: { xaxis: axis, yaxis: axis, zaxis: axis, aspectmode: "data", camera: { eye: { x: -0.9, y: -1.6, z: 1.1 } } },
    };
    if (!place.data) place.textContent = "";
    await Plotly.react(place, [trace], layout, { displaylogo: false, responsive: true, scrollZoom: true });
    caption.textContent = voxels.count.toLocaleString("en") + " voxels in this part.";
    document.documentElement.dataset.detail = name;
  }

  const choose = (event) => {
    const box = event.target.closest(".part");
    if (!box || (event.type === "keydown" && event.key !== "Enter" && event.key !== " ")) return;
    event.preventDefault();
    show(box).catch((reason) => {
      caption.textContent = "This part cannot be shown: " + reason.message + ".";
      document.documentElement.dataset.detail = "failed";
    });
  };
  detail.addEventListener("click", choose);
  detail.addEventListener("keydown", choose);
})();
