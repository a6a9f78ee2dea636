"""What a sequence says compared with what its images show, before anything is mapped."""
