for (const element of document.querySelectorAll(".arithmatex")) {
  // Arithmatex writes \(…\) and \[…\].
  katex.render(element.textContent.slice(2, -2), element, {
    displayMode: element.tagName === "DIV",
    throwOnError: false,
  });
}
