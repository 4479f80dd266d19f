"""Where units of work run: this process, processes of this machine, or a cluster."""
