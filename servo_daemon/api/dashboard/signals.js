// What signals are called, and in which unit they are: it is the end of their names.

const WORDS = {
  current_A: "Current", velocity_rad_s: "Speed", position_rad: "Position", voltage_V: "Voltage",
  temperature_C: "Temperature", velocity_m_s: "Speed", position_m: "Position", torque_Nm: "Torque",
};
const UNITS = [
  ["_rad_s", "rad/s"], ["_m_s", "m/s"], ["_rad", "rad"], ["_Nm", "N·m"], ["_A", "A"], ["_V", "V"], ["_C", "°C"],
  ["_K", "K"], ["_N", "N"], ["_m", "m"], ["_s", "s"],
];
const suffix = (name) => UNITS.find(([ending]) => name.endsWith(ending));

export const signalUnit = (name) => suffix(name)?.[1] ?? "";

export function signalWords(name) {
  const ending = suffix(name)?.[0] ?? "";
  return WORDS[name] ?? name.slice(0, name.length - ending.length).replaceAll("_", " ");
}
