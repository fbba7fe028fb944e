// The elements of the page, and the messages to screen readers.

export const byId = (id) => document.getElementById(id);

// Returns the value of the checked radio button of a group.
export const chosen = (name) => document.querySelector(`input[name=${name}]:checked`).value;

// Checks a radio button of a group.
export function choose(name, value) {
  document.querySelector(`input[name=${name}][value=${value}]`).checked = true;
}

// Returns the values of the checked boxes of a group.
export const checkedValues = (name) =>
  [...document.querySelectorAll(`input[name=${name}]:checked`)].map(({ value }) => value);

// Whether a button accepts clicks. Buttons use aria-disabled, because a button with the attribute
// `disabled` loses the focus.
export const isEnabled = (button) => button.getAttribute("aria-disabled") !== "true";

// Tells screen readers what happened.
export function announce(message) {
  byId("announcement").textContent = message;
}

// Sets the value of a <progress>. null shows a bar without a value.
export function setBar(bar, value) {
  if (value === null) bar.removeAttribute("value");
  else bar.value = value;
}
