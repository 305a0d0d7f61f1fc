for (const player of document.querySelectorAll("[data-frames]")) {
  const count = Number(player.dataset.frames), slider = player.querySelector("input");
  const times = player.dataset.times.split(","), label = player.querySelector("output");
  const button = player.querySelector("button");
  let timer = null;
  const show = k => {
    slider.value = k;
    label.textContent = times[k] + " s";
    for (const tile of player.querySelectorAll(".tile"))
      tile.style.backgroundPosition = (count > 1 ? 100 * k / (count - 1) : 0) + "% 0";
  };
  const stop = () => { clearInterval(timer); timer = null; button.textContent = "Play"; };
  slider.addEventListener("input", () => { stop(); show(Number(slider.value)); });
  button.addEventListener("click", () => {
    if (timer) return stop();
    button.textContent = "Pause";
    timer = setInterval(() => show((Number(slider.value) + 1) % count), 100);
  });
}
