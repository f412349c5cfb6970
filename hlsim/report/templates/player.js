// Switch between the sounds of a player at the same position, so that they can be compared.
{
  const maxStep = 12; // dB by which a sound may be louder than the one by which the volume was set
  // All players of a page have one volume. Keys switch between the sounds of the player used last.
  const shared = (window.hlsimPlayers ??= { volume: 0.5, loudness: null, player: null });
  const isPage = document.body.classList.contains("hlsim-page"); // not a notebook, which has keys
  const allSounds = () => document.querySelectorAll(".hlsim-player audio");

  const setVolume = (volume, loudness, note = "") => {
    Object.assign(shared, { volume, loudness });
    for (const text of document.querySelectorAll(".hlsim-player .lowered")) text.textContent = note;
    for (const slider of document.querySelectorAll(".hlsim-player .volume")) slider.value = volume;
    for (const audio of allSounds()) audio.volume = volume;
  };

  const start = (player) => {
    const find = (selector) => player.querySelector(selector);
    const figures = [...player.querySelectorAll(".sound")];
    const audios = figures.map((figure) => figure.querySelector("audio"));
    const loudness = figures.map((figure) => Number(figure.dataset.loudness));
    const position = find(".position");
    const seconds = Number(position.max);
    let current = audios[0];

    const show = () => {
      const time = Math.min(current.currentTime, seconds);
      position.value = time;
      find(".time").textContent = `${time.toFixed(1)} s`;
      find(".play").textContent = current.paused ? "Play" : "Pause";
      player.style.setProperty("--position", time / seconds);
    };
    const follow = () => {
      show();
      if (!current.paused) requestAnimationFrame(follow);
    };
    const play = () => {
      for (const audio of allSounds()) if (audio !== current) audio.pause();
      current.play().then(follow, show);
    };
    const protect = (number) => {
      const excess = loudness[number] - shared.loudness - maxStep;
      if (excess <= 0) return;
      const note = `Volume lowered by ${excess.toFixed(0)} dB, for one sound is much louder. Raise it with the slider.`;
      setVolume(shared.volume * 10 ** (-excess / 20), loudness[number], note);
    };
    const select = (number) => {
      shared.player = player;
      protect(number);
      const time = current.currentTime;
      const isPlaying = !current.paused;
      current.pause();
      current = audios[number];
      current.currentTime = time;
      figures.forEach((figure, other) => {
        figure.querySelector(".select").setAttribute("aria-pressed", other === number);
      });
      if (isPlaying) play();
      else show();
    };

    figures.forEach((figure, number) => {
      figure.querySelector(".select").addEventListener("click", () => {
        select(number);
        play();
      });
      const spectrogram = figure.querySelector(".spectrogram");
      spectrogram.addEventListener("click", (event) => {
        const box = spectrogram.getBoundingClientRect();
        select(number);
        current.currentTime = (seconds * (event.clientX - box.left)) / box.width;
        play();
      });
    });
    find(".play").addEventListener("click", () => (current.paused ? play() : current.pause()));
    position.addEventListener("input", () => {
      current.currentTime = Number(position.value);
      show();
    });
    find(".volume").addEventListener("input", (event) => {
      setVolume(Number(event.target.value), loudness[audios.indexOf(current)]);
    });
    find(".repeat").addEventListener("change", (event) => {
      for (const audio of audios) audio.loop = event.target.checked;
    });
    (isPage ? document : player).addEventListener("keydown", (event) => {
      const number = Number(event.key) - 1;
      const isPlain = !event.ctrlKey && !event.altKey && !event.metaKey;
      const isMeant = !isPage || shared.player === player;
      if (isPlain && isMeant && audios[number]) select(number);
    });
    for (const audio of audios) {
      audio.controls = false;
      audio.loop = true;
      audio.addEventListener("pause", show);
    }
    player.dataset.ready = "";
    setVolume(shared.volume, shared.loudness ?? loudness[0]);
    select(0);
  };

  document.querySelectorAll(".hlsim-player:not([data-ready])").forEach(start);
  shared.player = document.querySelector(".hlsim-player");
}
