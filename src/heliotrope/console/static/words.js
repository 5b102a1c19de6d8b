// The words of the page go through t(), which puts values into the {names} of a text.
export const t = (text, values = {}) => text.replace(/\{(\w+)\}/g, (whole, name) => values[name] ?? whole);
