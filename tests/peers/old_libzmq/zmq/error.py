class ZMQError(Exception):
    def __init__(self, errno, text):
        super(ZMQError, self).__init__(text)
        self.errno = errno
