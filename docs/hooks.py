"""What the site has beyond the pages of this folder: pages of the repository's root, files that
pages link to, and the notebooks.
"""

import re
from pathlib import Path

import nbformat
from mkdocs.structure.files import File
from nbconvert import MarkdownExporter

ROOT = Path(__file__).resolve().parents[1]
ROOT_PAGES = ("CHANGELOG.md", "CONTRIBUTING.md", "SECURITY.md")
LINKED_FILES = ("config/calibrator.yaml",)
# Factor of the search scores of the Python reference, whose names resemble words of questions.
REFERENCE_BOOST = 0.2


def on_files(files, config):
    """Add the files."""
    for name in (*ROOT_PAGES, *LINKED_FILES):
        files.append(
            File.generated(config, name, abs_src_path=str(ROOT / name))
        )
    for path in sorted((ROOT / "examples").glob("*.ipynb")):
        for name, content in notebook_files(path).items():
            files.append(
                File.generated(config, f"examples/{name}", content=content)
            )
    return files


def notebook_files(path):
    """A notebook with its outputs as a page and its pictures."""
    exporter = MarkdownExporter()
    notebook = nbformat.read(path, as_version=4)
    text, resources = exporter.from_notebook_node(notebook)
    pictures = {
        f"{path.stem}_{name}": data
        for name, data in resources["outputs"].items()
    }
    for name in resources["outputs"]:
        text = text.replace(f"({name})", f"({path.stem}_{name})")
    text = re.sub(r"<style.*?</style>", "", text, flags=re.DOTALL)
    return {f"{path.stem}.md": text, path.name: path.read_bytes(), **pictures}


def on_page_content(html, **_):
    """Roles of Sphinx in docstrings become plain names, empty headings of tables plain cells."""
    html = re.sub(r"<th[^>]*></th>", "<td></td>", html)
    return re.sub(
        r":\w+:<code>~?(?:[\w.]+\.)?(\w+)</code>", r"<code>\1</code>", html
    )


def on_page_markdown(markdown, page, config, **_):
    """Links between this folder and the root, which are neighbours on the site; tables of studies
    and the changelog are not searched.
    """
    source = page.file.src_uri
    if config.not_in_nav.match_file(source) or source == "CHANGELOG.md":
        page.meta["search"] = {"exclude": True}
    if source == "python.md":
        page.meta["search"] = {"boost": REFERENCE_BOOST}
    if page.file.src_uri in ROOT_PAGES:
        return markdown.replace("](docs/", "](")
    out = "../" * (page.file.src_uri.count("/") + 1)
    markdown = markdown.replace(f"]({out}", f"]({out[3:]}")
    return re.sub(r"(\]\([^)]*examples/\w+)\.ipynb\)", r"\1.md)", markdown)
