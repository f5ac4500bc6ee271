"""Reading and writing: trajectory files, bags, results. Imports nothing until it is used."""
