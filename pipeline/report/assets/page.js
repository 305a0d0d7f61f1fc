for (const player of document.querySelectorAll("[data-frames]")) {
  const count = Number(player.dataset.frames), slider = player.querySelector("input");
  const times = player.dataset.times.split(","), label = player.querySelector("output");
  const button = player.querySelector("button"), columns = Number(player.dataset.columns);
  const place = (k, of) => (of > 1 ? 100 * k / (of - 1) : 0) + "% ";
  let timer = null;
  const show = k => {
    slider.value = k;
    label.textContent = times[k] + " s";
    for (const tile of player.querySelectorAll(".tile"))
      tile.style.backgroundPosition = place(k % columns, columns) + place(Math.floor(k / columns), Math.ceil(count / columns));
  };
  const stop = () => { clearInterval(timer); timer = null; button.textContent = "Play"; };
  slider.addEventListener("input", () => { stop(); show(Number(slider.value)); });
  button.addEventListener("click", () => {
    if (timer) return stop();
    button.textContent = "Pause";
    timer = setInterval(() => show((Number(slider.value) + 1) % count), 100);
  });
}
for (const table of document.querySelectorAll("table.sortable")) {
  const heads = [...table.tHead.rows[0].cells];
  const key = cell => {
    const words = cell.textContent.trim().replace(/\u2212/g, "-"), number = parseFloat(words);
    return Number.isNaN(number) ? words : number;
  };
  heads.forEach((head, column) => {
    head.tabIndex = 0;
    const sort = () => {
      const down = head.getAttribute("aria-sort") === "ascending";
      heads.forEach(other => other.removeAttribute("aria-sort"));
      head.setAttribute("aria-sort", down ? "descending" : "ascending");
      const rows = [...table.tBodies[0].rows];
      const compare = (a, b) => {
        const x = key(a.cells[column]), y = key(b.cells[column]);
        if (typeof x !== typeof y) return typeof x === "number" ? -1 : 1;  // numbers first
        const order = typeof x === "number" ? x - y : x.localeCompare(y);
        return down ? -order : order;
      };
      rows.sort(compare).forEach(row => table.tBodies[0].append(row));
    };
    head.addEventListener("click", sort);
    head.addEventListener("keydown", event => { if (event.key === "Enter") sort(); });
  });
}
