"""What stands around the figures of a page: title, answer, glossary, an earlier page; and the index of all reports."""
