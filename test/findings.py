"""What a test reads of findings."""


def codes_of(findings):
    """Codes of findings, in their order."""
    return [finding.code for finding in findings]
