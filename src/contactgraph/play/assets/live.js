// The connection to the session, and the controls.

let socket = null;
let started = false;

function send(message) {
  if (socket && socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify(message));
}

function tell(text) {
  const notice = panel("notice");
  notice.hidden = !text;
  notice.textContent = text ?? "";
}

function fill(select, names, chosen) {
  select.replaceChildren(...names.map((name) => {
    const option = html("option", { value: name }, null, name);
    option.selected = name === chosen;
    return option;
  }));
}

function takeScene(message) {
  [live.number, live.step, live.frame] = [message.number, null, null];
  letGo();
  hand.sent.clear();
  clock.scene = liveScene(message.scene);
  clock.scene.disturbable = message.disturbable;
  clock.step = HISTORY;
  const { model, task, distractors } = message;
  live.choice = { model, task, distractors };
  panel("title").textContent = model === task ? `${model}, live` : `${model} in ${task}, live`;
  panel("lead").textContent = "A learned contact graph plans through contact, and you disturb it.";
  panel("distractors").textContent = distractors;
  panel("switch").hidden = !message.switches;
  panel("hand-words").hidden = !message.disturbable;
  fill(panel("model"), message.models, model);
  fill(panel("task"), message.tasks, task);
  if (!started) {
    started = true;
    startHand();
    startScene();
  }
  for (const listener of sceneListeners) listener();
}

function choose(name, value) {
  for (const input of document.querySelectorAll(`#${name} input`)) input.checked = input.value === value;
}

let noticed = "";
function takeControls(frame) {
  const button = panel("play");
  button.classList.toggle("playing", !frame.paused);
  button.setAttribute("aria-label", frame.paused ? "Play" : "Pause");
  choose("sensor", frame.sensor);
  choose("switch", frame.switch);
  panel("speed").value = String(frame.speed);
  const notice = JSON.stringify(frame.notice); // its number tells equal ones apart
  if (notice !== noticed) tell(frame.notice.text);
  noticed = notice;
}

function take(message) {
  if (message.type === "scene") takeScene(message);
  else if (message.type === "error") tell(message.text);
  else {
    takeFrame(message);
    takeControls(message);
  }
}

function connect() {
  socket = new WebSocket(`ws://${location.host}/session`);
  socket.addEventListener("message", ({ data }) => take(JSON.parse(data)));
  socket.addEventListener("close", ({ reason }) => {
    tell(reason || "The session has ended, or is not answering.");
    if (!reason) setTimeout(connect, 2000);
  });
  socket.addEventListener("open", () => tell(null));
}

function changeStage(changes) {
  if (live.choice) send({ wish: "stage", ...live.choice, ...changes });
}

function pauseOrPlay() {
  send({ wish: "pause", paused: !(live.frame?.paused ?? false) });
}

function startControls() {
  panel("play").addEventListener("click", pauseOrPlay);
  panel("step").addEventListener("click", () => send({ wish: "step" }));
  panel("reset").addEventListener("click", () => send({ wish: "reset" }));
  panel("speed").addEventListener("change", (event) => send({ wish: "speed", speed: Number(event.target.value) }));
  for (const name of ["sensor", "switch"]) {
    panel(name).addEventListener("change", (event) => send({ wish: name, [name]: event.target.value }));
  }
  panel("fewer").addEventListener("click", () => changeStage({ distractors: Math.max(0, live.choice.distractors - 1) }));
  panel("more").addEventListener("click", () => changeStage({ distractors: live.choice.distractors + 1 }));
  panel("change").addEventListener("click", () => {
    changeStage({ model: panel("model").value, task: panel("task").value, distractors: 0 });
  });
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.target.closest("input, select, button, summary, a")) return;
    if (event.key === " ") pauseOrPlay();
    else if (event.key === "ArrowRight") send({ wish: "step" });
    else return;
    event.preventDefault();
  });
}

startControls();
setInterval(drawPanels, 125);
requestAnimationFrame(drawLive);
connect();
