class SwinTransformer:
    def load_state_dict(self, _):
        raise AssertionError("not called")


def window_reverse():
    raise AssertionError("not called")
