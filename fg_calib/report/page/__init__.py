"""The report as one page of HTML: no network, no library in the browser, every name escaped."""
