// Light or dark: what the system prefers, until the button is pressed.

const preferred = matchMedia("(prefers-color-scheme: dark)");
const listeners = [];
let chosen = null;

export const isDark = () => chosen === null ? preferred.matches : chosen === "dark";
export const css = name => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

export function setTheme(theme) {
  chosen = theme;
  apply();
}

export const toggleTheme = () => setTheme(isDark() ? "light" : "dark");
export const onTheme = listener => listeners.push(listener);

function apply() {
  document.documentElement.dataset.theme = isDark() ? "dark" : "light";
  for (const listener of listeners) listener();
}

preferred.addEventListener("change", apply);
apply();
