"""The pages as a site: `make docs` writes it to build/docs/."""

project = "enerf-ns"
author = "The enerf-ns developers"
extensions = ["myst_parser"]
html_theme = "sphinx_book_theme"
html_title = "enerf-ns"
html_theme_options = {"show_toc_level": 2, "use_download_button": False, "navbar_persistent": []}
html_show_sourcelink = False
myst_heading_anchors = 3
