"""CSV and Markdown files."""

import csv


def write_csv(path, header, rows):
    """Write rows of values under a header; returns the path. Numbers keep all digits."""
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header)
        writer.writerows(rows)
    return path


def write_text(path, *blocks):
    """Write blocks of text, an empty line between them; returns the path."""
    path.write_text("\n\n".join(block for block in blocks if block) + "\n", encoding="utf-8")
    return path


def markdown_table(header, rows):
    """A Markdown table of strings and numbers."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(str(cell) for cell in line) + " |" for line in lines)


def bullets(items):
    """A Markdown list."""
    return "\n".join(f"- {item}" for item in items)


def percent(part, whole):
    """Such as "4328 of 4332 (99.91 %)", rounded down: only all is 100 %."""
    share = int(1e4 * part / whole) / 100 if whole else 0.0
    return f"{part} of {whole} ({share:.2f} %)"
