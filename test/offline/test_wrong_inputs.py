"""Wrong inputs: each is answered by one line that names the cause, with the right exit code."""

import gzip
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

import hand_eye_calib as hec
from hand_eye_calib.formats.files import local_path

# Exit code, command, and a part of the answer.
TABLE = """
2 | calibrat lidar.tum camera.tum | did you mean calibrate?
2 | calibrate lidar.tum | lidar.tum is one trajectory file: pass the files of two sensors
2 | calibrate lidar.tum lidar.tum | lidar.tum appears twice
1 | calibrate lidr.tum camera.tum | did you mean lidar.tum?
2 | calibrate sample:lidr.tum camera.tum | no sample:lidr.tum; the samples are arm.yaml, camera.tum
2 | calibrate sample:../x camera.tum | there is no sample:../x; the samples are
1 | info sample:nothing | there is no sample:nothing; the samples are
1 | calibrate empty.tum camera.tum | empty.tum: the file contains no poses; expected lines of 8
1 | calibrate comment.tum camera.tum | comment.tum: the file contains no poses
1 | calibrate one.tum camera.tum | the streams do not overlap in time
1 | calibrate few.tum camera.tum | 10 synchronised pose pairs are needed, found 3
1 | calibrate words.tum camera.tum | words.tum: no column for x, y, z, qx, qy, qz, qw
1 | calibrate binary.tum camera.tum | binary.tum: not a text file
1 | calibrate html.tum camera.tum | html.tum: it is a web page, perhaps of a sign-in
1 | calibrate short.tum camera.tum | 7 numbers in a line, tum has 8 (t x y z qx qy qz qw): is one
1 | calibrate quat2.tum camera.tum | line 1: found a quaternion of length 2
1 | calibrate zeroq.tum camera.tum | all 600 rows are empty, zero or not finite
1 | calibrate nan.tum camera.tum | all 600 rows are empty, zero or not finite
1 | calibrate far.tum camera.tum | line 1: position (1e+12,
1 | calibrate same_stamp.tum camera.tum | 600 poses have 5 different stamps; write all digits
1 | calibrate lidar.tum nohead.csv | name the 4 columns with --child-columns
1 | calibrate polish.csv camera.tum | names: Wysokość (m), Alfa (°), Beta (°), Gamma (°); name all
1 | calibrate lidar.tum polish.csv | --child-columns, such as t_s,x_m,y_m,z_m,roll_deg,pitch_deg,y
1 | calibrate apart/clock.csv camera.tum | name their column t (is it Uhr or Rest?), or set
1 | calibrate lidar.tum camera.tum few0.tum | few0 (child) with lidar (parent): 10 synchronised
1 | calibrate lidar.tum half.tum half2.tum | half and half2 have 0 poses at common times
1 | calibrate ublox.csv camera.tum | and the unit (u-blox writes 1e-7 deg as whole numbers)
2 | calibrate lidar.tum camera.tum result | to save the result in a folder, give --out result
2 | calibrate lidar.tum camera.tum --prior z=0.2,0.01 | write 0.2+/-0.01
2 | calibrate lidar.tum camera.tum --config root.yaml | leave out the section
2 | calibrate lidar.tum camera.tum --target-translation 5 | must be at most 1
2 | version | write hand_eye_calib --version
1 | calibrate commas.csv camera.tum | names 4 columns, but the rows have 8 cells; their numbers seem
1 | calibrate commas.txt camera.tum | with decimal points, or with ; between cells
1 | calibrate float32.tum camera.tum | are the same (numbers of 32 bits have steps of 128 s here)
1 | calibrate degrees.csv camera.tum | yaw_rad reaches 358.8, more than one turn (2 pi rad)
1 | calibrate tilt.csv camera.tum | pitch_rad reaches 12, more than one turn
1 | calibrate cells.tum camera.tum | for the timestamp
1 | calibrate nohead.csv camera.tum | name the 4 columns with --parent-columns, such as t,wx,wy,wz
1 | calibrate kitti.txt camera.tum --parent-times times.txt | 20 poses, but times.txt has 2 stamps
1 | calibrate image.png camera.tum | image.png: not a text file
1 | calibrate folder | no bag in folder: expected files that end in
2 | calibrate folder camera.tum | folder is a folder without a bag
1 | calibrate junk.mcap | repair it with 'mcap recover'
1 | calibrate junk.db3 | repair it with sqlite3's '.recover'
1 | calibrate junk.bag | repair it with 'rosbag reindex'
1 | calibrate cut.mcap | kind (it ends in the middle of a record, and no message before
2 | calibrate drive.mcap camera.tum | drive.mcap is a bag, and another path is not
1 | calibrate drive.mcap --parent-topic /lidar/odo | did you mean /lidar/odometry?
1 | calibrate drive.mcap --parent-topic /a --child-topic /a | no topic /a in
1 | calibrate drive.mcap --parent-topic a:b | no transforms in drive.mcap
2 | calibrate drive.mcap --parent-topic :b | two frames as WORLD:SENSOR, such as odom:lidar
2 | calibrate drive.mcap --child-fields t=x | --child-fields needs --child-topic
2 | calibrate drive.mcap --stamps now | invalid choice: 'now' (choose from
2 | calibrate lidar.tum camera.tum --stamps receive | --stamps applies to bags only
2 | calibrate lidar.tum camera.tum --max-gap fast | --max-gap: must be a number in s; got 'fast'
2 | calibrate lidar.tum camera.tum --max-gap 0,5 | got '0,5'; write 0.5
2 | calibrate lidar.tum camera.tum --max-gap -1 | --max-gap: must be at least 0.001 s; got -1.0
2 | calibrate lidar.tum camera.tum --max-gap nan | --max-gap: must be a finite number; got nan
2 | calibrate lidar.tum camera.tum --max-gab 1 | did you mean --max-gap?
2 | calibrate lidar.tum camera.tum --method best | --method: must be one of auto, dnlo
2 | calibrate lidar.tum camera.tum --reference D5 | must be auto, A, B<n> such as B5
2 | calibrate lidar.tum camera.tum --time-offset yes | must be estimate or a number in s; got 'yes'
2 | calibrate lidar.tum camera.tum --time-offset 35ms | got '35ms'; write 0.035
2 | calibrate lidar.tum camera.tum --max-gap "100 ms" | got '100 ms'; write 0.1
2 | calibrate lidar.tum camera.tum --method dnol | did you mean dnlo or dnl?
2 | calibrate lidar.tum camera.tum --scale 0 | --scale: must be at least
2 | calibrate lidar.tum camera.tum --prior z=1.85 | with its standard deviation; got '1.85'
2 | calibrate lidar.tum camera.tum --prior h=1+/-0.1 | AXIS one of x, y, z, roll, pitch, yaw
2 | calibrate lidar.tum camera.tum --prior z=22+/-2 | write 22cm+/-2cm or 22m+/-2m
2 | calibrate lidar.tum camera.tum --prior yaw=90+/-2 | write 90deg for degrees
2 | calibrate lidar.tum camera.tum --prior z=1+/-0 | needs a standard deviation above 0; got '0'
2 | calibrate lidar.tum camera.tum --prior z=1kg+/-0.1 | numbers in m or cm or mm; got '1kg'
2 | calibrate lidar.tum camera.tum --prior z=1deg+/-0.1 | or cm or mm; got '1deg' (see
2 | calibrate lidar.tum camera.tum --target-axes z | z must be numbers in m or cm or mm
2 | calibrate lidar.tum camera.tum --target-translation 0 | must be at least 1e-06 m; got 0.0
1 | calibrate lidar.tum camera.tum --config absent.yaml | cannot read absent.yaml
1 | calibrate lidar.tum camera.tum --config bad.yaml | bad.yaml is not readable YAML
2 | calibrate lidar.tum camera.tum --config list.yaml | expected a mapping of options to values
2 | calibrate lidar.tum camera.tum --config typo.yaml | 'max_gapp'; did you mean 'max_gap'?
2 | calibrate lidar.tum camera.tum --config value.yaml | 'max_gap' must be a number in s; got 'fast'
2 | calibrate lidar.tum camera.tum --config other.yaml | the file has those of /talker
2 | calibrate lidar.tum camera.tum --out junk.db3 --method park | junk.db3 is a file; give a folder
2 | calibrate lidar.tum camera.tum --out junk.db3/x | junk.db3 is a file; give a folder, such as
2 | simulate --out lidar.tum | --out: lidar.tum is a file; give a folder, such as drive/
2 | batch drive.mcap --out lidar.tum | --out: lidar.tum is a file; give a folder, such as drive/
2 | demo --out lidar.tum | --out: lidar.tum is a file; give a folder, such as drive/
2 | rig drive.mcap --out lidar.tum | --out: lidar.tum is a file; give a folder, such as drive/
2 | arm sample:arm.yaml --out lidar.tum | --out: lidar.tum is a file; give a folder, such as drive/
1 | calibrate rel.tum ms.tum | its stamps look like milliseconds; give --child-stamp-unit ms
1 | calibrate ms.tum rel.tum | ms.tum: one pose every 50 s for 17 h: its stamps look like
1 | rig rel.tum rel2.tum ms.tum | its stamps look like milliseconds; give --stamp-unit ms
1 | calibrate pair | run: hand_eye_calib calibrate pair/lidar.tum pair/camera.tum (parent first)
1 | check nested | nested itself, but in nested/bag: pass nested/bag, or all bags
1 | check truth | calibrate truth/lidar.tum truth/camera.tum (parent first)
1 | check trio | no bag in trio, but 3 trajectory files; for two of them, run: hand_eye_calib calib
1 | calibrate lidar.tum unstamped.csv | times.txt beside it was taken, because no column of
1 | calibrate lidar.tum unstamped.csv | name this column t, or give the right stamps with --child
1 | calibrate cut.tum camera.tum | cut.tum, line 48, the last line, is cut: 4 of 8 numbers; copy
1 | calibrate cut2.tum camera.tum | line 1000, the last line, is cut: 2 of 8 numbers; copy the file
1 | calibrate hole.tum camera.tum | hole.tum, line 1000: expected 8 numbers
2 | calibrate lidar.tum camera.tum --label vehicle | expected NAME=VALUE, such as vehicle=7
2 | calibrate lidar.tum camera.tum --base-frame base --method park | needs --installed ROBOT.urdf
1 | calibrate lidar.tum camera.tum --parent-frame a --child-frame a | are both 'a'; give each
2 | calibrate lidar.tum camera.tum --format kity | invalid choice: 'kity' (choose from 'tum'
1 | calibrate lidar.tum camera.tum --columns t,x | no column for y, z, qx, qy, qz, qw among t, x
1 | calibrate lidar.tum camera.tum --pair-by row | 1,200 in camera.tum: write a row
2 | calibrate lidar.tum camera.tum --pair-by row --time-offset estimate | --pair-by row ignores
2 | calibrate lidar.tum camera.tum --pair-by name --time-offset 0.1 | --time-offset needs stamps
2 | check lidar.tum camera.tum --pair-by row --time-offset 0.1 | --time-offset needs stamps, and
2 | rig lidar.tum camera.tum rel.tum --pair-by row --time-offset 0.1 | --time-offset needs stamps
1 | calibrate lidar.tum camera.tum --pair-by name | pair by time or row
2 | calibrate lidar.tum camera.tum --stamp-unit h | choose from 's', 'ms', 'us', 'ns'
2 | calibrate lidar.tum camera.tum --parent-quaternion zyxw | must be one of xyzw, wxyz, yzwx
1 | calibrate lidar.tum camera.tum --min-pairs 100000 | 100000 synchronised pose pairs are needed
2 | calibrate lidar.tum camera.tum --batch x | --batch cannot be combined with PATH
2 | calibrate lidar.tum camera.tum --vehicle x | hand_eye_calib batch BAG ... --vehicle x
2 | calibrate lidar.tum camera.tum --jobs 0 | expected a whole number of at least 1, got '0'
2 | calibrate lidar.tum camera.tum --setup hand | run arm with the samples of an arm
2 | calibrate lidar.tum camera.tum --parent-angles ur | it needs two files and --order none
2 | calibrate lidar.tum camera.tum --target 0 | the accuracy is --target-translation, --target-r
2 | calibrate lidar.tum camera.tum --target charuco:5x7 | --target and --camera go together
1 | calibrate samples.yaml | samples.yaml: the list of samples is empty; expected samples of an arm
1 | arm half.yaml | half.yaml, sample 1: robot has no tracking; each sample needs both poses
1 | calibrate lidar.tum camera.tum --columns t,x,x,y,z,qx,qy,qz,qw | 2 columns have the name x
2 | calibrate lidar.tum camera.tum --format kity | did you mean kitti?
1 | calibrate samples.npz | cannot read samples.npz: File is not a zip file
1 | arm lidar.tum camera.tum | by time: hand_eye_calib calibrate lidar.tum camera.tum
2 | arm sample:arm.yaml --setup both | invalid choice: 'both' (choose from 'hand', 'beside')
1 | rig lidar.tum camera.tum empty.tum | empty.tum: the file contains no poses
1 | rig drive.mcap --topics /lidar/odometry /camera/odometry /x | no topic /x in drive.mcap
1 | calibrate upper.csv camera.tum | upper.csv: it is a web page
1 | calibrate letter.tum camera.tum | letter.tum: it is a document of a word processor
1 | calibrate packed.tum camera.tum | packed.tum: it is a .zip archive or a spreadsheet; unpack it
1 | calibrate packed.gz camera.tum | packed.gz: it is compressed; unpack it with gunzip
1 | calibrate map.kml camera.tum | it is XML of an unsupported kind
2 | calibrate lidar.tum camera.tum --parent-topic /a | --parent-topic applies to bags only
2 | calibrate lidar.tum camera.tum --prior z=1,85+/-0.02 | z must be numbers in m or cm or mm
2 | calibrate lidar.tum camera.tum --stamp-unit nss | did you mean ns?
2 | calibrate lidar.tum camera.tum --target-translation far | must be numbers in m or cm or mm
1 | calibrate drive.mcap --parent-topic /cam --child-topic /lidar/odometry | no topic /cam in
1 | arm kuka.csv camera.tum | A, B and C seem to be angles of a robot; name its maker
2 | calibrate lidar.tum camera.tum --config topic.yaml | is no parameter; give --parent-topic TOPIC
2 | calibrate --parent lidar.tum --child camera.tum | without options, the parent first
2 | arm lidar.tum | lidar.tum contains no samples of an arm: expected a file that ends in
2 | arm folder | folder contains no samples of an arm
2 | arm lidar.tum lidar.tum | appears twice
2 | arm lidar.tum camera.tum --parent-angles kuca | did you mean kuka?
2 | arm sample:arm.yaml --setup besides | did you mean beside?
2 | batch folder | no bag matches folder/**: expected folders with a metadata.yaml
2 | batch lidar.tum | lidar.tum is not a bag, and batch takes bags: for trajectory files
2 | batch lidar.tum camera.tum --vehicle x | use calibrate PARENT CHILD
2 | batch lidar*.tumx | no file matches lidar*.tumx: check the folder and the name
2 | batch drive.mcap --vehicle {robot}/* | unknown placeholder {robot}; the
2 | batch drive.mcap --vehicle f/{Vehicle} | such as 'f/{vehicle}' (see
2 | batch drive.mcap --vehicle f/{} | the placeholder is {vehicle}, such as 'f/{vehi
2 | batch drive.mcap --vehicle "f/<robot>" | such as 'f/{vehicle}' (see
2 | batch drive.mcap --vehicle f/{vehicle | such as 'f/{vehicle}' (see
2 | batch drive.mcap --vehicle {vehicle}/{day} | {day}; the placeholder is {vehicle}
2 | batch drive.mcap --vehicle f/* | 'f/*' is a path without {vehicle}; put {vehicle} in place
2 | batch LIDAR*.tum | no file matches LIDAR*.tum: did you mean lidar.tum? Upper and lower
2 | check lidar.tum camera.tum --child-topic /a | --child-topic applies to bags only
1 | info robot.urdf | robot.urdf is a robot description, not a saved result
1 | info lidar.tum | a file of poses, not a saved result: calibrate PARENT CHILD --out DIR
1 | info torn.yaml | torn.yaml is not readable YAML
1 | compare torn.yaml --with robot.urdf | restore the file, or calibrate again
1 | calibrate saved | a saved result, not a recording: display it with hand_eye_calib info saved
1 | check saved | a saved result, not a recording: display it with hand_eye_calib info saved
1 | calibrate saved/extrinsic.yaml | display it with hand_eye_calib info saved/extrinsic.yaml
2 | lidar.tum camera.tum | put a command before it: hand_eye_calib calibrate lidar.tum camera.tum
1 | compare saved | to compare one result with the installed transform, add --with
1 | compare saved saved | saved appears twice: name each result once
1 | compare saved --with other.json | in it; pass extrinsic.yaml, a URDF, a bag, or "X Y
1 | compare saved --with lidar.tum | an installed transform is one pose
1 | compare saved --with robot.urdf | in the robot description; it has no transforms
2 | compare saved --with "400 0 1850 0 0 0" | needs a unit: 400 may be m, cm or mm; write 400mm or
2 | compare saved --with "0 -37.5 0 0 0 0" | write -37.5mm or -37.5m
2 | calibrate lidar.tum camera.tum --installed "0 0 22 0 0 0" | write 22mm or 22m
2 | compare saved --with "1 2 3 4 5" | 5 numbers; X Y Z ROLL PITCH YAW are 6
2 | export saved urdff | did you mean urdf?
2 | simulate --out new --drive hily | did you mean hilly?
2 | check | got 0: for example, hand_eye_calib check sample:lidar.tum sample:camera.tum
2 | check drive.mcap camera.tum | drive.mcap is a bag, and another path is not
1 | info absent | cannot read absent: No such file or directory
1 | info list.yaml | expected format hand_eye_calib/extrinsic
2 | info folder --as nothing | invalid choice: 'nothing' (choose from 'urdf'
1 | export folder urdf | folder has no extrinsic.yaml
2 | compare | required: RESULT
2 | simulate | required: --out
2 | simulate --out new --drive rocky | choose from 'published', 'hilly'
2 | watch --port x | unknown '--port' (
2 | calibrate lidar.tum camera.tum --fleet f.html | compare RESULT ... --fleet f.html
2 | calibrate lidar.tum camera.tum --fleet=f.html | hand_eye_calib compare RESULT ... --fleet=f.html
2 | check lidar.tum camera.tum --out x | --out is an option of calibrate
2 | check lidar.tum camera.tum --vehicle x | --vehicle is an option of batch: hand_eye_calib batch
2 | info saved --with a.urdf | compare: hand_eye_calib compare RESULT ... --with a.urdf
2 | compare saved --out x | --out is an option of calibrate
2 | calibrate lidar.tum camera.tum --force | unknown '--force' (
2 | calibrate lidar.tum --topic /a | unknown '--topic'; did you mean --parent-topic?
2 | calibrate lidar.tum camera.tum --method DNLO | did you mean dnlo?
2 | calibrate lidar.tum camera.tum --json out.json | end the command with > out.json
2 | export saved urdf out.urdf | end the command with > out.urdf
2 | calibrate lidar.tum camera.tum --target-rotation 0.3 | write 0.3deg for degrees
2 | arm arm.yaml hand.tum | arm.yaml has the samples of both sides: pass it alone
2 | help calibrate | write hand_eye_calib COMMAND --help
2 | calibrate lidar.tum camera.tum --prior z=1,85+/-0,02 | got '1,85'; write 1.85
2 | calibrate ticks.zip | ticks.zip is an archive: unpack it
2 | calibrate bag/metadata.yaml | describes a bag: pass its folder, bag
1 | calibrate ticks.csv lidar.tum | left_ticks has counts of an encoder: convert them to speeds
1 | calibrate oneside.csv lidar.tum | wheels need a column of the left and one of the right
2 | calibrate lidar.tum camera.tum --foobar | unknown '--foobar' (
2 | calibrate lidar.tum camera.tum --foo | unknown '--foo' (
2 | calibrate lidar.tum camera.tum -o x | unknown '-o'; did you mean --out? (
2 | calibrate lidar.tum camera.tum --mathod park | did you mean --method?
1 | calibrate lidar.tum camera.tum --time-offset 1000 | the streams overlap without it
1 | calibrate lidar.tum saved/extrinsic.yaml | extrinsic.yaml is a saved result, not a
1 | calibrate lidar.tum saved | a saved result, not a recording: display it with
2 | saved | put a command before it: hand_eye_calib info saved
2 | replay lidar.tum camera.tum | trajectory files: hand_eye_calib calibrate lidar.tum camera.tum
2 | watch lidar.tum | watch takes no file: it displays the running node
2 | calibrate "lidar.tum camera.tum" | leave out the quotes and commas: lidar.tum camera.tum
2 | calibrate lidar.tum,camera.tum | 2 files in one argument: leave out the quotes and commas
2 | calibrate lidar.tum camera.tum --prior z=1+/-1 yaw=1+/-1 | repeat --prior before each axis
2 | calibrate lidar.tum camera.tum --prior z=1+/-1 --prior z=2+/-1 | z was given twice; keep one
2 | calibrate lidar.tum camera.tum --method dnlo --method auto | --method was given twice; keep one
2 | calibrate lidar.tum camera.tum --out=a --out b | --out was given twice; keep one
2 | batch drive.mcap --jobs 1 --jobs 2 | --jobs was given twice; keep one
2 | calibrate lidar.tum camera.tum --label a=1 a=2 | --label a was given twice; keep one
2 | arm lidar.tum camera.tum --parent-angles foo | --parent-angles must be one of abb, fanuc
2 | calibrate lidar.tum camera.tum --topics /a /b | --topics applies to bags only
2 | calibrate lidar.tum camera.tum --out "" | the name is empty
2 | simulate --out "" | the name is empty
1 | calibrate lidar.tum camera.tum --reference B100000 | needs more than 100000 common poses
1 | arm nothing.yaml | nothing.yaml: the file is empty; expected samples
1 | info nothing.yaml | nothing.yaml: the file is empty; restore it
2 | arm lidar.tum image.png | is an image: pass the folder of images, --target and --camera
"""
ROWS = [
    [cell.strip() for cell in row.split(" | ")]
    for row in TABLE.strip().splitlines()
]

TEXTS = {
    "empty.tum": "",
    "ticks.zip": "PK",
    "ticks.csv": "t,left_ticks,right_ticks\n0,1,1\n1,1,1\n",
    "oneside.csv": "t,left_rad_s\n0,1\n1,1\n",
    "nothing.yaml": "",
    "comment.tum": "# nothing\n",
    "one.tum": "0 0 0 0 0 0 0 1\n",
    "words.tum": "hello world\nthis is text\n",
    "html.tum": "<html><body>404</body></html>\n",
    "upper.csv": "\n<!DOCTYPE HTML><HTML></HTML>\n",
    "letter.tum": "{\\rtf1\\ansi\n0 0 0 0 0 0 0 1\n",
    "packed.tum": "PK\x03\x04" + "0" * 20,
    "map.kml": "<kml></kml>\n",
    "torn.yaml": "format: {a: 1,\n",
    "robot.urdf": "<robot name='r'><link name='a'/></robot>",
    "nohead.csv": "0,1,2,3\n1,2,3,4\n",
    "commas.csv": "t,x,y,z\n" + "1,5,0,25,3,125,-4,5\n" * 20,
    "commas.txt": "1,5,0,25,3,125,-4,5,1,5,0,25,3,125,-4,5\n" * 20,
    "other.json": '{"a": 1}',
    "polish.csv": "Zeit (s);X (m);Y (m);Wysokość (m);Alfa (°);Beta (°);Gamma (°)\n"
    + "1;2;3;4;5;6;7\n" * 20,
    "kitti.txt": "1 0 0 0 0 1 0 0 0 0 1 0\n" * 20,
    "times.txt": "0\n1\n",
    "bad.yaml": "a: [1\n",
    "root.yaml": "hand_eye_calib:\n  max_gap: 0.2\n",
    "ublox.csv": "t,lat,lon,height\n" + "1,600000000,250000000,0\n" * 9,
    "list.yaml": "- 1\n- 2\n",
    "typo.yaml": "max_gapp: 1\n",
    "value.yaml": "max_gap: fast\n",
    "other.yaml": "/talker:\n  ros__parameters:\n    rate: 3\n",
    "topic.yaml": "parent_topic: /odom\n",
    "kuka.csv": "X,Y,Z,A,B,C\n" + "0.1,0.2,0.3,10,20,30\n" * 20,
    "samples.yaml": "samples: []\n",
    "half.yaml": "- robot: [1, 0, 0, 0, 0, 0, 1]\n",
    "samples.npz": "junk",
    "junk.mcap": "junk" * 10,
    "junk.db3": "junk" * 10,
    "junk.bag": "junk" * 10,
}


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("inputs")
    (folder / "folder").mkdir()
    for name in ("lidar.tum", "camera.tum", "drive.mcap"):
        shutil.copy(local_path(f"sample:{name}"), folder / name)
    for name, text in TEXTS.items():
        (folder / name).write_text(text)
    (folder / "binary.tum").write_bytes(bytes(range(256)) * 10)
    (folder / "image.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    (folder / "cut.mcap").write_bytes(
        (folder / "drive.mcap").read_bytes()[:3000]
    )
    (folder / "packed.gz").write_bytes(gzip.compress(b"0 0 0 0 0 0 0 1\n"))
    lidar, camera = (
        hec.read_trajectory(f"sample:{name}.tum")
        for name in ("lidar", "camera")
    )
    hec.save(hec.calibrate(lidar, camera), folder / "saved")
    write_poses(folder)
    return folder


def write_poses(folder):
    """Write trajectories of 600 poses, each with one fault."""
    rows = np.loadtxt(local_path("sample:lidar.tum"))
    double = rows.copy()
    double[:, 4:] *= 2.0
    no_rotation = rows.copy()
    no_rotation[:, 4:] = 0.0
    no_numbers = rows.copy()
    no_numbers[:, 1:] = np.nan
    far = rows.copy()
    far[:, 1] = 1e12
    repeated = rows.copy()
    repeated[5:, 0] = rows[4, 0]
    poses = {
        "short": rows[:, :7],
        "few": rows[:4],
        "half": rows[:300],
        "half2": rows[300:],
        "few0": np.c_[np.arange(30), rows[:30, 1:]],
        "quat2": double,
        "zeroq": no_rotation,
        "nan": no_numbers,
        "far": far,
        "same_stamp": repeated,
    }
    for name, table in poses.items():
        np.savetxt(folder / f"{name}.tum", table, fmt="%.9f")
    short = rows.copy()
    short[:, 0] = short[:, 0].astype(np.float32)
    np.savetxt(folder / "float32.tum", short, fmt="%.3f")
    # Angles in degrees under names of radians: a yaw that passes 360, and a pitch.
    angles = np.zeros((len(rows), 3))
    angles[:, 2] = np.arange(len(rows)) * 1.2 % 360.0
    write_angles(folder / "degrees.csv", rows, angles)
    angles[:, 1:] = [12.0, 0.0]
    write_angles(folder / "tilt.csv", rows, angles)
    header = "Uhr,Rest,x,y,z,qx,qy,qz,qw"
    # The file times.txt is not beside this file.
    path = folder / "apart" / "clock.csv"
    path.parent.mkdir()
    table = np.c_[rows[:, 0] - rows[0, 0], rows]
    np.savetxt(path, table, "%.9f", ",", header=header, comments="")
    write_times(folder, rows)
    text = (folder / "lidar.tum").read_text()
    (folder / "cells.tum").write_text(text.replace("1", "abc", 1))


def write_times(folder, rows):
    """Write streams with other stamps than the sample's, cut streams, and folders of streams."""
    camera = np.loadtxt(local_path("sample:camera.tum"))
    streams = {"rel": rows, "rel2": rows, "ms": camera}
    for name, stream in streams.items():
        relative = stream.copy()
        relative[:, 0] -= rows[0, 0]
        if name == "ms":
            relative[:, 0] *= 1000.0
        np.savetxt(folder / f"{name}.tum", relative, fmt="%.9f")
    header = "x,y,z,qx,qy,qz,qw"
    path = folder / "unstamped.csv"
    np.savetxt(path, rows[:, 1:], "%.9f", ",", header=header, comments="")
    lines = (folder / "camera.tum").read_text().splitlines(keepends=True)
    lines = [line for line in lines if not line.startswith("#")]
    for name, n_lines, n_cells in (("cut", 47, 4), ("cut2", 999, 2)):
        cut = " ".join(lines[n_lines].split()[:n_cells])
        (folder / f"{name}.tum").write_text("".join(lines[:n_lines]) + cut)
    (folder / "hole.tum").write_text(
        "".join([*lines[:999], f"{cut}\n", *lines[1000:]])
    )
    for name in ("pair", "trio"):
        (folder / name).mkdir()
        for file in ("lidar.tum", "camera.tum", "times.txt"):
            shutil.copy(folder / file, folder / name)
    shutil.copy(folder / "rel.tum", folder / "trio")
    for name in ("nested", "truth"):
        shutil.copytree(folder / "pair", folder / name)
        (folder / name / "a_truth.tum").write_text(lines[0])
    (folder / "nested" / "bag").mkdir()
    shutil.copy(folder / "drive.mcap", folder / "nested" / "bag")


def write_angles(path, rows, angles):
    """Write the stamps and positions of rows with angles in columns named as radians."""
    header = "t,x,y,z,roll_rad,pitch_rad,yaw_rad"
    table = np.c_[rows[:, :4], angles]
    np.savetxt(
        path, table, fmt="%.9f", delimiter=",", header=header, comments=""
    )


@pytest.mark.parametrize(
    ("code", "command", "message"), ROWS, ids=[row[1] for row in ROWS]
)
def test_a_wrong_input_is_answered_in_one_line(
    run, inputs, monkeypatch, code, command, message
):
    monkeypatch.chdir(inputs)
    exit_code, out, err = run(*shlex.split(command))
    assert (exit_code, out) == (int(code), "")
    lines = [
        line
        for line in err.splitlines()
        if not line.startswith("hand_eye_calib: note: ")
    ]
    assert len(lines) == 1
    assert lines[0].startswith("hand_eye_calib: error: ")
    assert message in lines[0]


def test_a_write_protected_folder_is_refused_before_the_solve(
    run, inputs, monkeypatch
):
    monkeypatch.chdir(inputs)
    monkeypatch.setattr("os.access", lambda path, mode: False)
    files = ("lidar.tum", "camera.tum")
    code, out, err = run("calibrate", *files, "--out", "folder/new")
    assert (code, out) == (2, "")
    assert "argument --out: folder is write-protected; choose another" in err


def test_there_are_sixty_wrong_inputs_or_more():
    assert len(ROWS) >= 60


def test_an_option_of_dnlo_has_a_note_with_another_method(run):
    paths = ("sample:lidar.tum", "sample:camera.tum")
    _, out, _ = run("calibrate", *paths, "--threshold", "0.5")
    words = " ".join(out.split())
    assert (
        "Note: the option threshold has no effect with method adaptive: only dnlo uses"
        in words
    )
    _, out, _ = run(
        "calibrate", *paths, "--threshold", "0.5", "--method", "dnlo"
    )
    assert "has no effect" not in out


def test_a_yaw_that_counts_turns_is_read_in_radians_with_a_note(tmp_path):
    rows = np.loadtxt(local_path("sample:lidar.tum"))
    angles = np.zeros((len(rows), 3))
    angles[:, 2] = np.linspace(0.0, 40.0, len(rows))
    write_angles(tmp_path / "turns.csv", rows, angles)
    with pytest.warns(
        UserWarning, match="yaw_rad reaches 40 rad, more than one turn"
    ):
        trajectory = hec.read_trajectory(tmp_path / "turns.csv", "auto")
    rotation = Rotation.from_matrix(trajectory.poses[-1, :3, :3])
    assert_allclose(np.sin(rotation.magnitude()), abs(np.sin(40.0)))


@pytest.mark.parametrize("factor", ["0.001", "0.01"])
def test_a_factor_that_the_lengths_do_not_need_is_the_first_reason(run, factor):
    paths = ("sample:lidar.tum", "sample:camera.tum")
    _, out, _ = run("calibrate", *paths, "--parent-scale", factor)
    words = " ".join(out.split())
    assert f"the parent's lengths were multiplied by {factor}, as" in words
    assert "omit the factor if the parent's lengths are metres: --par" in words
    assert "give positions of the child sensor itself" not in words


def test_a_folder_may_be_called_sample():
    assert local_path("sample") == Path("sample")
    assert local_path("sample/lidar.tum") == Path("sample/lidar.tum")


def test_the_name_of_a_frame_with_a_space_gets_a_note(run):
    paths = ("sample:lidar.tum", "sample:camera.tum")
    code, _, err = run("calibrate", *paths, "--parent-frame", "base link")
    assert (code, "'base link' contains a space; 'base_link' may" in err) == (
        0,
        True,
    )


def test_a_note_on_a_unit_names_the_other_unit_which_is_obeyed(tmp_path):
    rows = np.loadtxt(local_path("sample:lidar.tum"))[:, :3] * [1.0, 1e-5, 1e-5]
    path = tmp_path / "fixes.csv"
    np.savetxt(
        path, rows, "%.9f", ",", header="t,latitude,longitude", comments=""
    )
    with pytest.warns(UserWarning, match="read in rad, .* such as lon_deg"):
        in_rad = hec.read_trajectory(path, "auto")
    np.savetxt(path, rows, "%.9f", ",", header="t,lat_deg,lon_deg", comments="")
    with pytest.warns(UserWarning, match="positions only"):
        in_deg = hec.read_trajectory(path, "auto")
    lengths = [
        np.ptp(positions.poses[:, 0, 3]) for positions in (in_rad, in_deg)
    ]
    assert_allclose(lengths[0] / lengths[1], np.degrees(1.0), rtol=1e-3)


@pytest.mark.parametrize("name", ["wrong.tum", "missing.yaml"])
def test_a_file_of_another_name_is_not_proposed(run, inputs, monkeypatch, name):
    """A common suffix does not make names similar."""
    monkeypatch.chdir(inputs)
    _, _, err = run("calibrate", name, "lidar.tum")
    assert f"cannot read {name}" in err
    assert "did you mean" not in err


def test_a_topic_that_another_sensor_has_is_not_proposed(
    run, inputs, monkeypatch
):
    monkeypatch.chdir(inputs)
    topics = [
        "--parent-topic",
        "/lidr/odometry",
        "--child-topic",
        "/lidar/odometry",
    ]
    _, _, err = run("calibrate", "drive.mcap", *topics)
    assert "no topic /lidr/odometry in drive.mcap" in err
    assert "did you mean /lidar/odometry" not in err


def test_an_option_of_the_second_file_is_named_and_obeyed(run, tmp_path):
    samples = hec.read_arm_samples("sample:arm.yaml")
    stops = samples.robot
    degrees = Rotation.from_matrix(stops[:, :3, :3]).as_euler(
        "ZYX", degrees=True
    )
    np.savetxt(tmp_path / "hand.txt", np.c_[stops[:, :3, 3], degrees])
    child = Rotation.from_matrix(
        np.linalg.inv(samples.tracking)[:, :3, :3]
    ).as_quat()
    rows = np.c_[np.linalg.inv(samples.tracking)[:, :3, 3], child]
    header = "x,y,z,qx,qy,qz,qw"
    np.savetxt(
        tmp_path / "camera.csv", rows, delimiter=",", header=header, comments=""
    )
    paths = [str(tmp_path / name) for name in ("hand.txt", "camera.csv")]
    _, _, err = run("arm", *paths, "--parent-angles", "kuka")
    assert (
        "camera.csv is read as format csv; to change this, set --child-format"
        in err
    )
    columns = ["--child-columns", "x,y,z,qx,qy,qz,q"]
    code, _, err = run("arm", *paths, "--parent-angles", "kuka", *columns)
    assert (code, "no column for qw" in err) == (1, True)


def test_a_pattern_that_fits_no_recording_is_named(run, inputs, monkeypatch):
    monkeypatch.chdir(inputs)
    shutil.copy("drive.mcap", "drive2.mcap")
    _, _, err = run(
        "batch", "drive.mcap", "drive2.mcap", "--vehicle", "{vehicle}/*/x"
    )
    assert (
        "--vehicle '{vehicle}/*/x' fits none of their paths; set it to" in err
    )


@pytest.mark.filterwarnings("error")
def test_a_sensor_that_never_moves_is_named_without_warnings_of_numpy(
    run, tmp_path
):
    rows = np.loadtxt(local_path("sample:camera.tum"))
    rows[:, 1:] = rows[0, 1:]
    np.savetxt(tmp_path / "still.tum", rows, fmt="%.9f")
    code, out, _ = run(
        "calibrate", "sample:lidar.tum", str(tmp_path / "still.tum")
    )
    assert code == 3
    assert "the child stream repeats the same pose" in out
