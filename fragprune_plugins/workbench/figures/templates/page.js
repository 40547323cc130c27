// A divider: all pictures of one section are cut at the same place.
addEventListener("input", ({ target }) =>
  target.closest("section")?.style.setProperty("--cut", target.value + "%"))
