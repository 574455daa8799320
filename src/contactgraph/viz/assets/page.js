// Joins the controls to the clock, and starts everything.

const calm = matchMedia("(prefers-reduced-motion: reduce)");

// Buttons of which one is chosen; nothing is shown where there is nothing to choose.
function choices(id, options, choose) {
  const set = document.getElementById(id);
  set.hidden = options.length < 2;
  options.forEach((option, place) => {
    const label = html("label", {}, set);
    const input = html("input", { type: "radio", name: id }, label);
    input.checked = place === 0;
    label.append(option.name);
    input.addEventListener("change", () => choose(option));
  });
}

function showControls() {
  const { scene, step, playing } = clock;
  const slider = document.getElementById("time");
  const button = document.getElementById("play");
  const time = `${(step * scene.dt).toFixed(2)} s`;
  slider.max = scene.steps;
  slider.value = step;
  slider.setAttribute("aria-valuetext", time);
  document.getElementById("now").textContent = time;
  button.classList.toggle("playing", playing);
  button.setAttribute("aria-label", playing ? "Pause" : "Play");
}

// In words, for those who do not see the canvas; written when it stands still.
function describeScene() {
  if (clock.playing) return;
  const { scene, step } = clock;
  const sure = scene.edges.map((_, edge) => edge).filter((edge) => beliefAt(scene, edge, step) >= 0.5);
  const edges = sure.map((edge) => `${scene.edgeName[edge]} (${beliefAt(scene, edge, step).toFixed(2)})`);
  const words = edges.length ? `Edges believed active: ${edges.join(", ")}.` : "No edge is believed active.";
  const sentence = `${(step * scene.dt).toFixed(2)} s. ${words}`;
  document.getElementById("scene-words").textContent = sentence;
  view.canvas.setAttribute("aria-label", `The scene seen from ${scene.dimension < 3 ? "above" : "aside"}. ${sentence}`);
}

function onKey(event) {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  if (event.target.closest("input, select, button, summary, a")) return;
  if (event.key === " ") {
    if (clock.playing) pause();
    else play();
  } else if (event.key === "ArrowRight" || event.key === "ArrowLeft") {
    const direction = event.key === "ArrowRight" ? 1 : -1;
    pause();
    seek(Math.round(clock.step) + direction);
  } else return;
  event.preventDefault();
}

// Plays once when first seen, unless the reader asked for calm: then it rests at the grasp.
function playWhenSeen() {
  seek(clock.scene.grasp ?? 0);
  if (calm.matches) return;
  const watch = new IntersectionObserver((entries) => {
    if (!entries.some((entry) => entry.isIntersecting)) return;
    watch.disconnect();
    seek(0);
    play();
  }, { threshold: 0.6 });
  watch.observe(view.canvas);
}

function startWatching() {
  startScene();
  startTimePlots();
  timeListeners.push(showControls, describeScene);
  choices("scene-choice", payload.scenes.map((scene) => ({ name: scene.name, scene })), ({ scene }) => {
    if (clock.span) clock.span = graspSpan(scene);
    chooseScene(scene);
  });
  const spans = [{ name: "whole trajectory", near: false }];
  if (payload.scenes.some((scene) => scene.grasp !== null)) spans.push({ name: "around the contact", near: true });
  choices("span-choice", spans, ({ near }) => showSpan(near ? graspSpan(clock.scene) : null));
  document.getElementById("play").addEventListener("click", () => (clock.playing ? pause() : play()));
  document.getElementById("time").addEventListener("input", (event) => {
    const step = Number(event.target.value); // read first: pausing puts the slider back
    pause();
    seek(step);
  });
  document.getElementById("speed").addEventListener("change", (event) => {
    clock.speed = Number(event.target.value);
  });
  document.addEventListener("keydown", onKey);
  window.addEventListener("beforeprint", () => {
    pause();
    seek(clock.scene.grasp ?? clock.scene.steps);
  });
  playWhenSeen();
}

if (payload.scenes.length) startWatching();
startBeliefChart();
startErrorChart();
startReliabilityChart();
startLossChart();
